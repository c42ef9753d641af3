"""Portraits for training: whole people whose light, skin and clothes differ in every photo.

`bake_portrait` photographs a person once and keeps what does not depend on light and appearance: the facets
of the image with their surface, and how much of each rig light reaches them. `photograph` shades them with
any appearance under any lights, in a few hundredths of a second, with the truth beside it.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np
import torch
from torch import Tensor

from facerf_cli.face.topology import CONTOUR, RAYS_PER_LANDMARK, silhouette_ids
from facerf_cli.light.mesh_transport import MeshTransport, bake_mesh
from facerf_cli.light.sh import sh_basis
from facerf_cli.light.transport import BakeSettings
from facerf_cli.portrait.classes import MORE_LANDMARKS
from facerf_cli.raster.camera import project
from facerf_cli.synth.appearance.materials import Appearance, MaterialPoints, sample
from facerf_cli.synth.head.body import clearance_m
from facerf_cli.synth.head.mesh import PARTS
from facerf_cli.synth.renderer import Lenses, irradiance_factors, lenses_in, reflections
from facerf_cli.synth.shading import Strands, strand_cosines, strand_highlights, unit_along, widened_lobes
from facerf_cli.synth.subjects import Subject
from facerf_cli.synth.views import StageCamera, facets_of, truth_of

_BOUNCE_ORDER = 3  # of the spherical harmonics that hold bounced light
_HIGHLIGHTS = 12  # only the brightest lights have highlights
_LEAST_COSINE = 0.05  # below it a facet's visibility cannot be derived from its irradiance
_HAIR = PARTS.index("hair")
_MISSING = (math.nan,) * 3


@dataclass(frozen=True, eq=False)
class BakedPortrait:
    """One image [S, S] of a person, as N facets: parts of the mesh in a pixel; vectors in camera space.

    pixel [N] int32, row by row; share [N] float16 of the pixel; part [N] uint8; uv [N, 2] float32 of the
    part's texture; normals, tangents [N, 3] and spread [N] (variance of the normals) float16; positions_m
    [N, 3] float32; direct [N, L] uint8, of 255: visibility of each light, on surfaces times n.l; bounce
    [N, 16] float16: spherical harmonics of the light after one bounce off white surroundings; directions
    [L, 3] of the lights; classes [S, S, C] uint8: shares, of 255; landmarks_px [68 + M, 2]; rotation [3, 3]:
    head_to_camera; lens_*: see `Lenses`.
    """

    pixel: Tensor
    share: Tensor
    part: Tensor
    uv: Tensor
    normals: Tensor
    tangents: Tensor
    spread: Tensor
    positions_m: Tensor
    direct: Tensor
    bounce: Tensor
    directions: Tensor
    classes: Tensor
    landmarks_px: Tensor
    rotation: Tensor
    lens_pixel: Tensor
    lens_normals: Tensor
    lens_views: Tensor

    @property
    def side_px(self) -> int:
        """Side of the image."""
        return len(self.classes)


@dataclass(frozen=True, eq=False)
class PortraitPhoto:
    """A photo [3, S, S] over black, scene-linear, and its truth; alpha [S, S], classes [C, S, S] in 0..1."""

    image: Tensor
    alpha: Tensor
    classes: Tensor
    albedo: Tensor  # [3, S, S] times alpha
    normals: Tensor  # [3, S, S] unit, camera space; 0 off the person
    specular: Tensor  # [S, S] share of the person's radiance that highlights make, without those of lenses


def bake_portrait(
    subject: Subject, camera: StageCamera, directions: np.ndarray, settings: BakeSettings, seed: int
) -> BakedPortrait:
    """Bake what a camera sees of a person under lights from world-space `directions` [L, 3]."""
    return view_of(subject, bake_subject(subject, [camera], directions, settings, seed), camera)


def bake_subject(
    subject: Subject,
    cameras: Sequence[StageCamera],
    directions: np.ndarray,
    settings: BakeSettings,
    seed: int,
) -> MeshTransport:
    """Bake the light transport of all that some of the cameras can see of a person."""
    mesh = subject.mesh
    axes = np.stack([camera.head_to_camera.numpy()[2] for camera in cameras])
    return bake_mesh(
        mesh.vertices,
        mesh.normals,
        mesh.triangles,
        directions,
        settings,
        seed,
        wanted=(mesh.normals @ axes.T).max(1) > -0.3,
        two_sided=mesh.part == _HAIR,
        clearance_m=clearance_m(mesh),
    )


def view_of(subject: Subject, transport: MeshTransport, camera: StageCamera) -> BakedPortrait:
    """Bake what one camera sees of a person whose light transport is known."""
    mesh, directions = subject.mesh, transport.directions
    facets, shares, pixels = facets_of(mesh, subject.appearance, camera, relief=False)
    direct, bounce = irradiance_factors(mesh, transport)
    basis = sh_basis(torch.from_numpy(directions).float() @ camera.head_to_camera.T.float(), _BOUNCE_ORDER)
    direct = np.where((mesh.part == _HAIR)[:, None], transport.visibility.T, direct)
    seen = facets.corners @ direct[facets.vertices]
    bounced = torch.from_numpy(facets.corners @ bounce[facets.vertices])
    rotation = camera.head_to_camera.float()
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
        positions_m=points @ rotation.T + camera.translation_m.float(),
        direct=torch.from_numpy((255 * seen).round().clip(0, 255).astype(np.uint8)),
        bounce=(bounced @ torch.linalg.pinv(basis).T).half(),
        directions=torch.from_numpy(directions).float() @ rotation.T,
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
    rotation = camera.head_to_camera.float()
    face = subject.face_vertices @ subject.head_to_world.T.float()
    face_px = project(face @ rotation.T + camera.translation_m, camera.camera)
    outline = silhouette_ids(face_px[None], (rotation @ subject.head_to_world)[None])[0]
    more = [subject.more_landmarks_world.get(name, _MISSING) for name in MORE_LANDMARKS]
    points = torch.from_numpy(np.concatenate([subject.landmarks_world, more])).float()
    found = project(points @ rotation.T + camera.translation_m, camera.camera)
    found[list(CONTOUR)] = face_px[outline[::RAYS_PER_LANDMARK]]
    return found


def photograph(portrait: BakedPortrait, appearance: Appearance, weights: Tensor) -> PortraitPhoto:
    """Shade a portrait under weights [L, 3] of its lights, with the truth of the photo."""
    surface = materials_of(portrait, appearance)
    lit = _Lit.of(portrait, surface)
    highlights = lit.highlights(weights)
    normals, radiance = portrait.normals.float(), lit.diffuse(weights) + highlights
    summed = lit.summed(torch.cat([radiance, surface.albedo, normals, highlights], 1))
    specular = summed[:, 9:].mean(1) / summed[:, :3].mean(1).clamp_min(1e-6)
    side = portrait.side_px
    image = lit.through_lenses(summed[:, :3], weights)
    albedo, normal = summed[:, 3:9].T.view(2, 3, side, side)
    classes = portrait.classes.permute(2, 0, 1).float() / 255
    alpha = lit.summed(torch.ones(len(portrait.pixel), 1)).view(side, side)
    return PortraitPhoto(image, alpha, classes, albedo, unit_along(normal, 0), specular.view(side, side))


def images_under(portrait: BakedPortrait, surface: MaterialPoints, weights: Tensor) -> Tensor:
    """Images [M, 3, S, S] of a portrait of materials [N] under M sums, weights [M, L, 3], of its lights."""
    lit = _Lit.of(portrait, surface)
    return torch.stack(
        [lit.through_lenses(lit.summed(lit.diffuse(one) + lit.highlights(one)), one) for one in weights]
    )


def albedo_of(portrait: BakedPortrait, surface: MaterialPoints) -> tuple[Tensor, Tensor]:
    """Albedo and normals [3, S, S] of a portrait of materials [N]; both are times its share of the pixel."""
    columns = torch.cat([surface.albedo, portrait.normals.float()], 1) * portrait.share.float()[:, None]
    side = portrait.side_px
    summed = torch.zeros(side * side, 6).index_add_(0, portrait.pixel.long(), columns)
    albedo, normals = summed.T.reshape(2, 3, side, side)
    return albedo, normals


@dataclass(frozen=True, eq=False)
class _Lit:
    """The shading of a portrait's facets; no light scatters under the skin."""

    portrait: BakedPortrait
    surface: MaterialPoints
    hair: Tensor  # [N] bool
    direct: Tensor  # [N, L], hair's with the cosine of its strands
    views: Tensor  # [N, 3]
    strands: Strands

    @classmethod
    def of(cls, portrait: BakedPortrait, surface: MaterialPoints) -> "_Lit":
        views = unit_along(-portrait.positions_m, 1)
        hair = portrait.part == _HAIR
        strands = Strands(
            portrait.tangents.float()[hair], views[hair], surface.specular[hair], surface.roughness[hair]
        )
        direct = portrait.direct.float() / 255
        normals = portrait.normals.float()[hair]
        direct[hair] *= strand_cosines(strands.tangents, normals, portrait.directions)
        return cls(portrait, surface, hair, direct, views, strands)

    def diffuse(self, weights: Tensor) -> Tensor:
        """Radiance [N, 3] without highlights."""
        basis = sh_basis(self.portrait.directions, _BOUNCE_ORDER)
        bounced = (self.portrait.bounce.float() @ (basis.T @ weights)).clamp_min(0)
        albedo = self.surface.albedo
        return albedo * (self.direct @ weights + albedo.mean(0) * bounced)

    def highlights(self, weights: Tensor) -> Tensor:
        """Radiance [N, 3] of the brightest lights' highlights."""
        portrait, surface, smooth = self.portrait, self.surface, ~self.hair
        bright = weights.sum(1).topk(min(_HIGHLIGHTS, int((weights.sum(1) > 0).sum()))).indices
        lights, power = portrait.directions[bright], weights[bright]
        visible = portrait.direct[:, bright].float() / 255
        normals = portrait.normals.float()[smooth]
        gloss = widened_lobes(
            normals,
            self.views[smooth],
            lights,
            surface.specular[smooth],
            surface.roughness[smooth],
            portrait.spread.float()[smooth],
        )
        n_dot_l = (normals @ lights.T).clamp_min(_LEAST_COSINE)
        found = torch.zeros(len(surface.albedo), 3)
        found[smooth] = (gloss * (visible[smooth] / n_dot_l).clamp(0, 1)) @ power
        white, coloured = (
            lobe * visible[self.hair] @ power for lobe in strand_highlights(self.strands, lights)
        )
        found[self.hair] = white + coloured * surface.albedo[self.hair]
        return found

    def summed(self, columns: Tensor) -> Tensor:
        """Values [N, C] of the facets, summed over pixels [S * S, C]."""
        share, pixels = self.portrait.share.float()[:, None], self.portrait.side_px**2
        return torch.zeros(pixels, columns.shape[1]).index_add_(
            0, self.portrait.pixel.long(), columns * share
        )

    def through_lenses(self, radiance: Tensor, weights: Tensor) -> Tensor:
        """Radiance [S * S, 3] with the reflections of lenses, as an image [3, S, S]."""
        portrait, side = self.portrait, self.portrait.side_px
        lenses = Lenses(
            portrait.lens_pixel.long(), portrait.lens_normals.float(), portrait.lens_views.float()
        )
        seen, transmitted = reflections(lenses, portrait.directions)
        radiance = radiance.clone()
        radiance[lenses.pixels] = radiance[lenses.pixels] * transmitted[:, None] + seen @ weights
        return radiance.T.reshape(3, side, side)


def materials_of(portrait: BakedPortrait, appearance: Appearance) -> MaterialPoints:
    """Sample the materials of the facets [N]."""
    return sample(appearance, portrait.part.long(), portrait.uv)


def portrait_tensors(portrait: BakedPortrait) -> dict[str, Tensor]:
    """A portrait's tensors by name, for a file."""
    return {field.name: getattr(portrait, field.name).contiguous() for field in fields(portrait)}
