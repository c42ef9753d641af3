"""Portraits for training: whole people whose light, skin and clothes differ in every photo.

`view_of` photographs a person once and keeps what does not depend on light and appearance: the facets
of the image with their surface, and how much of each rig light reaches them. `images_under` shades them with
any materials under any lights, in a few hundredths of a second.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np
import torch
from torch import Tensor

from facerf_cli.face.topology import CONTOUR, RAYS_PER_LANDMARK, silhouette_ids
from facerf_cli.light.mesh_transport import MeshTransport
from facerf_cli.light.sh import sh_basis
from facerf_cli.light.transport import BakeSettings
from facerf_cli.portrait.parse import MORE_LANDMARKS
from facerf_cli.raster.camera import project
from facerf_cli.synth.appearance.materials import Appearance, sample
from facerf_cli.synth.head.mesh import PARTS
from facerf_cli.synth.renderer import Lenses, bake_person, irradiance_factors, lenses_in, reflections
from facerf_cli.synth.shading import (
    Material,
    Strands,
    strand_cosines,
    strand_highlights,
    unit_along,
    widened_lobes,
)
from facerf_cli.synth.subjects import Subject
from facerf_cli.synth.views import StageCamera, facets_of, truth_of

_BOUNCE_ORDER = 3  # of the spherical harmonics that hold bounced light
_HIGHLIGHTS = 12  # only the brightest lights have highlights
_LEAST_COSINE = 0.05  # below it a facet's visibility cannot be derived from its irradiance
_HAIR = PARTS.index("hair")
_MISSING = (math.nan,) * 3


@dataclass(frozen=True, eq=False)
class BakedPortrait:
    """One image [S, S] of a person, as N facets: parts of the mesh in a pixel; vectors in camera space."""

    pixel: Tensor  # [N] int32, row by row
    share: Tensor  # [N] float16, of the pixel
    part: Tensor  # [N] uint8
    uv: Tensor  # [N, 2] float32 of the part's texture
    normals: Tensor  # [N, 3] float16
    tangents: Tensor  # [N, 3] float16
    spread: Tensor  # [N] float16, variance of the normals
    positions_m: Tensor  # [N, 3] float32
    direct: Tensor  # [N, L] uint8, of 255: visibility of each light, on surfaces times n.l
    bounce: Tensor  # [N, 16] float16: spherical harmonics of light after one bounce off white surroundings
    directions: Tensor  # [L, 3] of the lights
    classes: Tensor  # [S, S, C] uint8: shares, of 255
    landmarks_px: Tensor  # [68 + M, 2]
    rotation: Tensor  # [3, 3] head_to_camera
    lens_pixel: Tensor  # see `Lenses`
    lens_normals: Tensor
    lens_views: Tensor

    @property
    def side_px(self) -> int:
        return len(self.classes)

    def summed(self, columns: Tensor) -> Tensor:
        """Values [N, C] of the facets, summed over pixels [S * S, C] by their shares."""
        total = torch.zeros(self.side_px**2, columns.shape[1])
        return total.index_add_(0, self.pixel.long(), columns * self.share.float()[:, None])

    @property
    def alpha(self) -> Tensor:
        """Cover [S, S] of the person."""
        return self.summed(torch.ones(len(self.pixel), 1)).view(self.side_px, -1)


def bake_subject(
    subject: Subject,
    cameras: Sequence[StageCamera],
    directions: np.ndarray,
    settings: BakeSettings,
    seed: int,
) -> MeshTransport:
    """Bake the light transport of all that some cameras see of a person, of lights at directions [L, 3]."""
    axes = np.stack([camera.head_to_camera.numpy()[2] for camera in cameras])
    wanted = (subject.mesh.normals @ axes.T).max(1) > -0.3
    return bake_person(subject.mesh, directions, settings, seed, wanted)


def view_of(subject: Subject, transport: MeshTransport, camera: StageCamera) -> BakedPortrait:
    """Bake what one camera sees of a person whose light transport is known."""
    mesh, directions = subject.mesh, transport.directions
    facets, shares, pixels = facets_of(mesh, subject.appearance, camera, relief=False)
    direct, bounce = irradiance_factors(mesh, transport)
    rotation = camera.head_to_camera.float()
    lights = torch.from_numpy(directions).float() @ rotation.T
    basis = sh_basis(lights, _BOUNCE_ORDER)
    direct = np.where((mesh.part == _HAIR)[:, None], transport.visibility.T, direct)
    seen = facets.corners @ direct[facets.vertices]
    bounced = torch.from_numpy(facets.corners @ bounce[facets.vertices])
    points = torch.from_numpy(facets.corners @ mesh.vertices[facets.vertices]).float()
    truth = truth_of(mesh, subject.appearance, camera)
    owner = np.repeat(pixels, np.diff(shares.indptr))
    lenses = Lenses(torch.zeros(0, dtype=torch.long), torch.zeros(0, 3), torch.zeros(0, 3))
    if subject.lenses is not None:
        lenses = lenses_in(subject.lenses, camera, -truth.positions_m[..., 2])
    return BakedPortrait(
        pixel=torch.from_numpy(owner).int(),
        share=torch.from_numpy(shares.data).half(),
        part=facets.part.byte(),
        uv=facets.uv,
        normals=(facets.normals @ rotation.T).half(),
        tangents=(facets.tangents @ rotation.T).half(),
        spread=facets.spread.half(),
        positions_m=camera.to_camera(points),
        direct=torch.from_numpy((255 * seen).round().clip(0, 255).astype(np.uint8)),
        bounce=(bounced @ torch.linalg.pinv(basis).T).half(),
        directions=lights,
        classes=torch.from_numpy((255 * truth.classes).round().astype(np.uint8)),
        landmarks_px=_landmarks_px(subject, camera),
        rotation=rotation @ subject.head_to_world.float(),
        lens_pixel=lenses.pixels.int(),
        lens_normals=lenses.normals.half(),
        lens_views=lenses.views.half(),
    )


def _landmarks_px(subject: Subject, camera: StageCamera) -> Tensor:
    """Landmarks [68 + M, 2] of an image; those of the jaw lie on its outline, as detectors place them.

    The others are `MORE_LANDMARKS`; NaN for those that a person does not have.
    """
    face = subject.face_vertices @ subject.head_to_world.T.float()
    face_px = project(camera.to_camera(face), camera.camera)
    outline = silhouette_ids(face_px[None], (camera.head_to_camera @ subject.head_to_world)[None])[0]
    more = [subject.more_landmarks_world.get(name, _MISSING) for name in MORE_LANDMARKS]
    points = torch.from_numpy(np.concatenate([subject.landmarks_world, more])).float()
    found = project(camera.to_camera(points), camera.camera)
    found[list(CONTOUR)] = face_px[outline[::RAYS_PER_LANDMARK]]
    return found


def images_under(portrait: BakedPortrait, surface: Material, weights: Tensor) -> Tensor:
    """Images [M, 3, S, S] of a portrait of materials [N] under M sums, weights [M, L, 3], of its lights.

    They are scene-linear, over black.
    """
    lit = _Lit(portrait, surface)
    return torch.stack([lit.image(one) for one in weights])


def albedo_of(portrait: BakedPortrait, surface: Material) -> tuple[Tensor, Tensor]:
    """Albedo and normals [3, S, S] of a portrait of materials [N]; both are times its share of the pixel."""
    summed = portrait.summed(torch.cat([surface.albedo, portrait.normals.float()], 1))
    albedo, normals = summed.T.reshape(2, 3, portrait.side_px, portrait.side_px)
    return albedo, normals


class _Lit:
    """The shading of a portrait's facets; no light scatters under the skin."""

    def __init__(self, portrait: BakedPortrait, surface: Material) -> None:
        self.portrait, self.surface = portrait, surface
        self.views = unit_along(-portrait.positions_m, 1)  # [N, 3]
        self.hair = hair = portrait.part == _HAIR  # [N]
        self.strands = Strands(
            portrait.tangents.float()[hair], self.views[hair], surface.specular[hair], surface.roughness[hair]
        )
        self.direct = portrait.direct.float() / 255  # [N, L], hair's with the cosine of its strands
        normals = portrait.normals.float()[hair]
        self.direct[hair] *= strand_cosines(self.strands.tangents, normals, portrait.directions)

    def image(self, weights: Tensor) -> Tensor:
        """The image [3, S, S] under weights [L, 3] of the lights."""
        radiance = self.portrait.summed(self._diffuse(weights) + self._highlights(weights))
        return self._through_lenses(radiance, weights)

    def _diffuse(self, weights: Tensor) -> Tensor:
        """Radiance [N, 3] without highlights."""
        basis = sh_basis(self.portrait.directions, _BOUNCE_ORDER)
        bounced = (self.portrait.bounce.float() @ (basis.T @ weights)).clamp_min(0)
        albedo = self.surface.albedo
        return albedo * (self.direct @ weights + albedo.mean(0) * bounced)

    def _highlights(self, weights: Tensor) -> Tensor:
        """Radiance [N, 3] of the brightest lights' highlights."""
        portrait, surface, smooth = self.portrait, self.surface.part(~self.hair), ~self.hair
        bright = weights.sum(1).topk(min(_HIGHLIGHTS, int((weights.sum(1) > 0).sum()))).indices
        lights, power = portrait.directions[bright], weights[bright]
        visible = portrait.direct[:, bright].float() / 255
        normals, spread = portrait.normals.float()[smooth], portrait.spread.float()[smooth]
        gloss = widened_lobes(
            normals, self.views[smooth], lights, surface.specular, surface.roughness, spread
        )
        n_dot_l = (normals @ lights.T).clamp_min(_LEAST_COSINE)
        found = torch.zeros(len(self.hair), 3)
        found[smooth] = (gloss * (visible[smooth] / n_dot_l).clamp(0, 1)) @ power
        white, coloured = (
            lobe * visible[self.hair] @ power for lobe in strand_highlights(self.strands, lights)
        )
        found[self.hair] = white + coloured * self.surface.albedo[self.hair]
        return found

    def _through_lenses(self, radiance: Tensor, weights: Tensor) -> Tensor:
        """Radiance [S * S, 3] with the reflections of lenses, as an image [3, S, S]."""
        portrait, side = self.portrait, self.portrait.side_px
        lenses = Lenses(
            portrait.lens_pixel.long(), portrait.lens_normals.float(), portrait.lens_views.float()
        )
        seen, transmitted = reflections(lenses, portrait.directions)
        radiance[lenses.pixels] = radiance[lenses.pixels] * transmitted[:, None] + seen @ weights
        return radiance.T.reshape(3, side, side)


def materials_of(portrait: BakedPortrait, appearance: Appearance) -> Material:
    """Sample the materials of the facets [N]."""
    return sample(appearance, portrait.part.long(), portrait.uv)


def portrait_tensors(portrait: BakedPortrait) -> dict[str, Tensor]:
    """A portrait's tensors by name, for a file."""
    return {field.name: getattr(portrait, field.name).contiguous() for field in fields(portrait)}
