"""Render synthetic people with any materials and lights.

`bake_light` computes the irradiance of each light at the vertices of a person's mesh. `view_of` keeps what
one camera sees of it: the facets of the image, and how much of each light reaches them. `images_under`
shades them in a few hundredths of a second.

Light spreads under the skin in the image: the irradiance of a pixel is a mean over near pixels of skin,
weighted by a Gaussian in the distance of their surfaces (after Jimenez et al., *Screen-space perceptual
rendering of human skin*, 2009). Lenses of glasses lie over the finished image, without refraction.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Self

import numpy as np
import torch
import torch.nn.functional as F
from scipy.sparse import csr_matrix
from torch import Tensor

from facerf_cli.face.topology import CONTOUR, RAYS_PER_LANDMARK, silhouette_ids
from facerf_cli.light.mesh_transport import MeshTransport, bake_mesh
from facerf_cli.light.sh import sh_basis
from facerf_cli.light.transport import BakeSettings
from facerf_cli.portrait.parse import MORE_LANDMARKS
from facerf_cli.raster.camera import project
from facerf_cli.raster.rasterize import interpolate, rasterize
from facerf_cli.synth.appearance.materials import Appearance, sample
from facerf_cli.synth.head.body import clearance_m
from facerf_cli.synth.head.mesh import PARTS, HeadMesh
from facerf_cli.synth.person import SyntheticPerson
from facerf_cli.synth.shading import (
    Material,
    Strands,
    strand_cosines,
    strand_highlights,
    unit_along,
    widened_lobes,
)
from facerf_cli.synth.views import StageCamera, facets_of, layers_of, surface_samples

_BOUNCE_ORDER = 3  # of the spherical harmonics that hold bounced light
_HIGHLIGHTS = 12
_LEAST_COSINE = 0.05  # below it a facet's visibility cannot be derived from its irradiance
_LEAST_FACING = -0.3  # cosine to the nearest axis of a camera below which a vertex is not baked
_RELIEF_SOFTNESS = 0.15  # stands for light from all sides, which keeps bumps from going black
_SCATTER_REACH, _SCATTER_MOST_PX = 2.5, 16  # of the kernel: in sigmas, and at most in pixels
_LEAST_SIGMA_PX = 0.25  # light that spreads less than this is not blurred
_AT_ONCE = 16  # images shaded together
_REFLECTANCE = 0.04  # of one surface of a lens at normal incidence: a refractive index of 1.5
_SURFACES = 2  # of a lens
_SHARPNESS = 150.0  # of the lobe that spreads a light over its surroundings
_SKIN, _HAIR = PARTS.index("skin"), PARTS.index("hair")
_MISSING = (math.nan,) * 3
_IN_BYTES, _IN_HALVES = ("direct", "classes"), ("share", "normals", "bent", "tangents", "spread", "bounce")


@dataclass(frozen=True, eq=False)
class PersonLight:
    """Unscattered irradiance [V, L] of the vertices by each light of rgb 1 from `directions` [L, 3].

    `direct` is 1 on a surface that faces the light; `bounced` is what other parts of the person reflect.
    """

    directions: np.ndarray
    direct: np.ndarray
    bounced: np.ndarray


def bake_light(
    person: SyntheticPerson,
    cameras: Sequence[StageCamera],
    directions: np.ndarray,
    settings: BakeSettings,
    seed: int,
) -> PersonLight:
    """Bake the light of all that some cameras see of a person, from directions [L, 3] in world space."""
    mesh = person.mesh
    axes = np.stack([camera.head_to_camera.numpy()[2] for camera in cameras])
    transport = bake_mesh(
        mesh.vertices,
        mesh.normals,
        mesh.triangles,
        directions,
        settings,
        seed,
        wanted=(mesh.normals @ axes.T).max(1) > _LEAST_FACING,
        two_sided=mesh.is_part("hair"),
        clearance_m=clearance_m(mesh),
    )
    return light_of(person, transport)


def light_of(person: SyntheticPerson, transport: MeshTransport) -> PersonLight:
    """Compute the irradiance of a person with two diffuse bounces, which are tinted by mean colours later."""
    mesh = person.mesh
    lights = torch.from_numpy(transport.directions).float()
    normals, hair = torch.from_numpy(mesh.normals).float(), torch.from_numpy(mesh.part == _HAIR)
    cosines = (normals @ lights.T).clamp_min(0)
    cosines[hair] = strand_cosines(torch.from_numpy(mesh.tangents).float()[hair], normals[hair], lights)
    surface = sample(person.appearance, torch.from_numpy(mesh.part), torch.from_numpy(mesh.uv).float())
    albedo = surface.albedo.mean(1).numpy()[transport.sites][:, None]
    direct = transport.visibility.T * cosines.numpy()
    radiosity = albedo * direct[transport.sites]
    bounced = transport.gathered(radiosity)
    bounced = transport.gathered(radiosity + albedo * bounced)
    direct[hair.numpy()] = transport.visibility.T[hair.numpy()]  # the cosine of strands varies in a facet
    return PersonLight(transport.directions, direct, bounced[transport.site_of] * transport.baked[:, None])


@dataclass(frozen=True, eq=False)
class Lenses:
    """Lenses in pixels [N] of an image [S, S], numbered row by row; their normals and views [N, 3]."""

    pixels: Tensor
    normals: Tensor
    views: Tensor


def lenses_in(lenses: HeadMesh | None, camera: StageCamera, depth_m: np.ndarray) -> Lenses:
    """Find the pixels that show lenses in front of everything else, of depth [H, W] in m, 0 for nothing."""
    if lenses is None:
        return Lenses(torch.zeros(0, dtype=torch.long), torch.zeros(0, 3), torch.zeros(0, 3))
    vertices = camera.to_camera(torch.from_numpy(lenses.vertices))
    triangles = torch.from_numpy(lenses.triangles)
    fragments = rasterize(vertices, triangles, camera.camera)
    normals = torch.from_numpy(lenses.normals) @ camera.head_to_camera.T
    surface = interpolate(torch.cat([vertices, normals], 1), triangles, fragments)
    unobstructed = torch.from_numpy(depth_m == 0) | (-surface[..., 2] < torch.from_numpy(depth_m))
    pixels = (fragments.covered & unobstructed).flatten().nonzero()[:, 0]
    position, normal = torch.split(surface.flatten(0, 1)[pixels], 3, 1)
    return Lenses(pixels, F.normalize(normal, dim=1), F.normalize(-position, dim=1))


def reflections(lenses: Lenses, directions: Tensor) -> tuple[Tensor, Tensor]:
    """Return the radiance [N, L] of each light of a rig in the lenses, and their transmittance [N].

    A light of weight 1 stands for a cell of the sphere with a radiance of pi over its solid angle
    (docs/design.md, 'Units of light').
    """
    cosine = (lenses.normals * lenses.views).sum(1)
    mirrored = 2 * cosine[:, None] * lenses.normals - lenses.views
    weights = (_SHARPNESS * mirrored @ directions.T).softmax(1)
    fresnel = _REFLECTANCE + (1 - _REFLECTANCE) * (1 - cosine.abs().clamp(0, 1)) ** 5
    reflected = _SURFACES * fresnel / (1 + fresnel)
    return reflected[:, None] * weights * (len(directions) / 4), 1 - reflected


@dataclass(frozen=True, eq=False)
class BakedView:
    """What S x S pixels show of a person, as N facets: parts of the mesh in a pixel; camera space."""

    pixel: Tensor  # [N] int32, row by row
    share: Tensor  # [N] of the pixel
    part: Tensor  # [N] uint8
    uv: Tensor  # [N, 2] of the part's texture
    normals: Tensor  # [N, 3] smooth
    bent: Tensor  # [N, 3] normals with the relief of the person's own materials
    tangents: Tensor  # [N, 3]
    spread: Tensor  # [N] variance of the normals
    positions_m: Tensor  # [N, 3]
    direct: Tensor  # [N, L] visibility of each light in 0..1, on surfaces times n.l
    bounce: Tensor  # [N, 16] spherical harmonics of light that bounced, for a mean albedo of 1
    directions: Tensor  # [L, 3] of the lights
    classes: Tensor  # [S, S, C] fraction of each class in a pixel
    landmarks_px: Tensor  # [68 + M, 2]
    rotation: Tensor  # [3, 3] head_to_camera
    scattering_m: Tensor  # [3] sigma, see `Appearance`
    lens_pixel: Tensor  # see `Lenses`
    lens_normals: Tensor
    lens_views: Tensor

    @property
    def alpha(self) -> Tensor:
        """Matte of the person [S, S]."""
        return 1 - self.classes[..., 0]

    def summed(self, columns: Tensor) -> Tensor:
        """Sum values [N, C] of the facets over the pixels [S * S, C], weighted by their shares."""
        total = torch.zeros(self.alpha.numel(), columns.shape[1])
        return total.index_add_(0, self.pixel.long(), columns * self.share[:, None])

    def packed(self) -> dict[str, Tensor]:
        """Return the tensors by name in bytes, halves and floats, for a file."""
        tensors = {field.name: getattr(self, field.name).contiguous() for field in fields(self)}
        in_bytes = {name: (255 * tensors[name]).round().clamp(0, 255).byte() for name in _IN_BYTES}
        return tensors | in_bytes | {name: tensors[name].half() for name in _IN_HALVES}

    @classmethod
    def unpacked(cls, tensors: dict[str, Tensor]) -> Self:
        """Restore a view from its `packed` tensors."""
        in_bytes = {name: tensors[name].float() / 255 for name in _IN_BYTES}
        return cls(**tensors | in_bytes | {name: tensors[name].float() for name in _IN_HALVES})


def view_of(person: SyntheticPerson, light: PersonLight, camera: StageCamera) -> tuple[BakedView, Material]:
    """Bake what one camera sees of a person whose light is known; return also the own materials [N]."""
    mesh = person.mesh
    samples = surface_samples(mesh, camera)
    facets, shares, pixels = facets_of(mesh, person.appearance, camera, samples)
    rotation = camera.head_to_camera.float()
    lights = torch.from_numpy(light.directions).float() @ rotation.T
    direct, bounced = (
        torch.from_numpy(facets.corners @ values[facets.vertices]) for values in (light.direct, light.bounced)
    )
    bounce = bounced @ torch.linalg.pinv(sh_basis(lights, _BOUNCE_ORDER)).T
    points = torch.from_numpy(facets.corners @ mesh.vertices[facets.vertices]).float()
    classes, depth_m = layers_of(mesh, samples, camera)
    lenses = lenses_in(person.lenses, camera, depth_m)
    view = BakedView(
        pixel=torch.from_numpy(np.repeat(pixels, np.diff(shares.indptr))).int(),
        share=torch.from_numpy(shares.data),
        part=facets.part.byte(),
        uv=facets.uv,
        normals=facets.normals @ rotation.T,
        bent=facets.bent @ rotation.T,
        tangents=facets.tangents @ rotation.T,
        spread=facets.spread,
        positions_m=camera.to_camera(points),
        direct=direct,
        bounce=bounce / facets.surface.albedo.mean().clamp_min(1e-6),
        directions=lights,
        classes=torch.from_numpy(classes),
        landmarks_px=_landmarks_px(person, camera),
        rotation=rotation @ person.head_to_world.float(),
        scattering_m=person.appearance.scattering_mm / 1000,
        lens_pixel=lenses.pixels.int(),
        lens_normals=lenses.normals,
        lens_views=lenses.views,
    )
    return view, facets.surface


def _landmarks_px(person: SyntheticPerson, camera: StageCamera) -> Tensor:
    """Project landmarks [68 + M, 2]; the jaw's lie on its outline, where detectors place them.

    The others are `MORE_LANDMARKS`; NaN for those that a person does not have.
    """
    face = person.face_vertices @ person.head_to_world.T.float()
    face_px = project(camera.to_camera(face), camera.camera)
    outline = silhouette_ids(face_px[None], (camera.head_to_camera @ person.head_to_world)[None])[0]
    more = [person.more_landmarks_world.get(name, _MISSING) for name in MORE_LANDMARKS]
    points = torch.from_numpy(np.concatenate([person.landmarks_world, more])).float()
    landmarks_px = project(camera.to_camera(points), camera.camera)
    landmarks_px[list(CONTOUR)] = face_px[outline[::RAYS_PER_LANDMARK]]
    return landmarks_px


def materials_of(view: BakedView, appearance: Appearance) -> Material:
    """Sample other materials of the facets [N] than the person's own."""
    return sample(appearance, view.part.long(), view.uv)


def albedo_of(view: BakedView, surface: Material) -> tuple[Tensor, Tensor]:
    """Return albedo and normals [3, S, S] of a view with materials [N]; both are times its coverage."""
    summed = view.summed(torch.cat([surface.albedo, view.normals], 1))
    albedo, normals = summed.T.reshape(2, 3, *view.alpha.shape)
    return albedo, normals


def images_under(
    view: BakedView, surface: Material, weights: Tensor, highlights: int = _HIGHLIGHTS
) -> Tensor:
    """Render scene-linear images [M, 3, S, S] over black of a view with materials [N].

    weights [M, L, 3] belong to the view's lights in each image. Only the brightest lights, `highlights` of
    them, have highlights.
    """
    shading = _Shading(view, surface, highlights)
    return torch.cat([shading.images(some) for some in torch.split(weights, _AT_ONCE)])


class _Shading:
    """Shading of a view's facets, with all that does not depend on the weights of the lights."""

    def __init__(self, view: BakedView, surface: Material, highlights: int) -> None:
        self.view, self.surface, self.highlights = view, surface, highlights
        self.views = unit_along(-view.positions_m, 1)  # [N, 3]
        self.hair = hair = view.part == _HAIR  # [N]
        self.strands = Strands(
            view.tangents[hair], self.views[hair], surface.specular[hair], surface.roughness[hair]
        )
        bent, smooth = ((normals @ view.directions.T).clamp_min(0) for normals in (view.bent, view.normals))
        # Relief scales diffuse light, to first order, by the ratio of cosines with and without it.
        self.diffuse = view.direct * (bent + _RELIEF_SOFTNESS) / (smooth + _RELIEF_SOFTNESS)  # [N, L]
        self.diffuse[hair] = view.direct[hair] * strand_cosines(
            self.strands.tangents, view.normals[hair], view.directions
        )
        self.basis = sh_basis(view.directions, _BOUNCE_ORDER)
        self.skin = (view.part == _SKIN).nonzero()[:, 0].numpy()
        self.kernels = _scattering_kernels(view, self.skin)
        self.lenses = Lenses(view.lens_pixel.long(), view.lens_normals, view.lens_views)

    def images(self, weights: Tensor) -> Tensor:
        """Render images [M, 3, S, S] under weights [M, L, 3]."""
        view = self.view
        columns = weights.transpose(0, 1).flatten(1)  # [L, M * 3]
        bounced = (view.bounce @ (self.basis.T @ columns)).clamp_min(0)
        irradiance = (self.diffuse @ columns).view(len(view.part), -1, 3)
        irradiance = irradiance + self.surface.albedo.mean(0) * bounced.view(irradiance.shape)
        for channel, kernels in enumerate(self.kernels):
            on_skin = irradiance[self.skin, :, channel].numpy()
            for kernel in kernels:
                on_skin = kernel @ on_skin
            irradiance[self.skin, :, channel] = torch.from_numpy(on_skin)
        radiance = self.surface.albedo[:, None] * irradiance  # [N, M, 3]
        return torch.stack(
            [self._image(radiance[:, k] + self._highlights(one), one) for k, one in enumerate(weights)]
        )

    def _highlights(self, weights: Tensor) -> Tensor:
        """Compute the radiance [N, 3] of the highlights of the brightest lights."""
        view, surface, smooth = self.view, self.surface.part(~self.hair), ~self.hair
        power = weights.sum(1)
        bright = power.topk(min(self.highlights, int((power > 0).sum()))).indices
        lights, visible = view.directions[bright], view.direct[:, bright]
        gloss = widened_lobes(
            view.bent[smooth],
            self.views[smooth],
            lights,
            surface.specular,
            surface.roughness,
            view.spread[smooth],
        )
        n_dot_l = (view.normals[smooth] @ lights.T).clamp_min(_LEAST_COSINE)
        radiance = torch.zeros(len(self.hair), 3)
        radiance[smooth] = (gloss * (visible[smooth] / n_dot_l).clamp(0, 1)) @ weights[bright]
        white, coloured = (
            lobe * visible[self.hair] @ weights[bright] for lobe in strand_highlights(self.strands, lights)
        )
        radiance[self.hair] = white + coloured * self.surface.albedo[self.hair]
        return radiance

    def _image(self, radiance: Tensor, weights: Tensor) -> Tensor:
        """Sum radiance [N, 3] over the pixels, and lay the lenses over them: [3, S, S]."""
        pixels = self.view.summed(radiance)
        mirrored, transmitted = reflections(self.lenses, self.view.directions)
        at = self.lenses.pixels
        pixels[at] = pixels[at] * transmitted[:, None] + mirrored @ weights
        return pixels.T.reshape(3, *self.view.alpha.shape)


def _scattering_kernels(view: BakedView, skin: np.ndarray) -> list[list[csr_matrix]]:
    """Build matrices [n, n] per channel that scatter light among n facets of skin, along rows and columns."""
    (height, width), positions_m = view.alpha.shape, view.positions_m.numpy()[skin]
    share = view.share.numpy()[skin]
    pixel = view.pixel.numpy()[skin]
    facet_in = np.full((height, width), -1)
    facet_in.ravel()[pixel] = np.arange(len(skin))
    sigmas_m = view.scattering_m.tolist()
    both = (facet_in[:, 1:] >= 0) & (facet_in[:, :-1] >= 0)
    if not both.any() or not any(sigmas_m):
        return [[], [], []]
    steps_m = np.linalg.norm(positions_m[facet_in[:, 1:][both]] - positions_m[facet_in[:, :-1][both]], axis=1)
    pixel_m = float(np.quantile(steps_m, 0.1))  # of a surface that faces the camera
    kernels: list[list[csr_matrix]] = []
    for sigma_m in sigmas_m:
        reach = min(math.ceil(_SCATTER_REACH * sigma_m / pixel_m), _SCATTER_MOST_PX)
        blurs = [] if sigma_m < _LEAST_SIGMA_PX * pixel_m else [(0, 1), (1, 0)]
        kernels.append([])
        for down, right in blurs:
            rows, columns, values = [], [], []
            for step in range(-reach, reach + 1):
                y, x = pixel // width + step * down, pixel % width + step * right
                inside = (y >= 0) & (y < height) & (x >= 0) & (x < width)
                near = np.where(inside, facet_in[y.clip(0, height - 1), x.clip(0, width - 1)], -1)
                on = np.flatnonzero(near >= 0)
                squared = ((positions_m[near[on]] - positions_m[on]) ** 2).sum(1)
                rows.append(on)
                columns.append(near[on])
                values.append(share[near[on]] * np.exp(-0.5 * squared / sigma_m**2))
            matrix = csr_matrix(
                (np.concatenate(values), (np.concatenate(rows), np.concatenate(columns))),
                shape=(len(skin),) * 2,
                dtype=np.float32,
            )
            matrix.data /= np.repeat(np.asarray(matrix.sum(1))[:, 0], np.diff(matrix.indptr))
            kernels[-1].append(matrix)
    return kernels
