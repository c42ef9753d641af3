"""Images of a synthetic head under one light at a time, from its baked light transport, and its glasses.

Irradiance is stored at the vertices of the mesh. Per channel, all images of a camera are one sparse product:
area x albedo x barycentric weights [facets, V] times irradiance [V, L]. Highlights are shaded per facet.
Lenses lie over finished images, since nothing else here is transparent; what they refract is left out.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import torch
import torch.nn.functional as F
from scipy.sparse import csr_matrix
from scipy.spatial import cKDTree
from torch import Tensor

from facerf_cli.light.mesh_transport import MeshTransport, bake_mesh
from facerf_cli.light.transport import BakeSettings
from facerf_cli.raster.rasterize import interpolate, rasterize
from facerf_cli.synth.appearance.materials import Appearance, sample
from facerf_cli.synth.head.body import clearance_m
from facerf_cli.synth.head.mesh import PARTS, HeadMesh, doubled_areas
from facerf_cli.synth.shading import Strands, strand_cosines, strand_highlights, widened_lobes
from facerf_cli.synth.views import Facets, StageCamera, facets_of

_SKIN, _HAIR = PARTS.index("skin"), PARTS.index("hair")
_CHUNK = 1 << 19  # pixels x lights shaded at a time; fits the CPU caches
_LIGHTS = 25  # lights bounced at a time
_NEAR = 32  # neighbours that one pass of scattering reaches
_RELIEF_SOFTNESS = 0.15  # stands for light from all sides, which keeps bumps from going black


@dataclass(frozen=True)
class RenderSettings:
    """Diffuse bounces and effects to render; `gloss` and `relief` are switched off to compare renderers."""

    bounces: int = 2
    scattering: bool = True
    gloss: bool = True
    relief: bool = True


def bake_person(
    mesh: HeadMesh, directions: np.ndarray, settings: BakeSettings, seed: int, wanted: np.ndarray
) -> MeshTransport:
    """Bake the light transport of a person's vertices `wanted` [V] under lights at directions [L, 3]."""
    return bake_mesh(
        mesh.vertices,
        mesh.normals,
        mesh.triangles,
        directions,
        settings,
        seed,
        wanted=wanted,
        two_sided=mesh.is_part("hair"),
        clearance_m=clearance_m(mesh),
    )


def photograph(
    head: HeadMesh,
    appearance: Appearance,
    transport: MeshTransport,
    camera: StageCamera,
    settings: RenderSettings = RenderSettings(),
    irradiance: np.ndarray | None = None,
) -> tuple[Tensor, Tensor]:
    """Render linear images [L, 3, H, W], one per light of rgb 1, and coverage [H, W] in 0..1.

    `irradiance` is the result of `scattered_irradiance`, which several cameras can share.
    """
    if irradiance is None:
        irradiance = scattered_irradiance(head, appearance, transport, settings)
    facets, shares, pixels = facets_of(head, appearance, camera, settings.relief)
    height, width = camera.camera.height_px, camera.camera.width_px
    lights = len(transport.directions)
    visibility = np.ascontiguousarray(transport.visibility[:, facets.vertices].T)
    images = torch.zeros(lights, 3, height * width)
    step = max(1, _CHUNK // lights)
    for first in range(0, len(pixels), step):
        some = slice(first, min(first + step, len(pixels)))
        rows = slice(shares.indptr[some.start], shares.indptr[some.stop])
        area = shares[some, rows]
        shaded = _shaded(facets.part_of(rows), transport.directions, visibility, irradiance, settings)
        for channel, radiance in enumerate(shaded):
            images[:, channel, pixels[some]] = torch.from_numpy(area @ radiance).T
    coverage = torch.zeros(height * width)
    coverage[pixels] = torch.from_numpy(np.asarray(shares.sum(1))[:, 0])
    return images.view(lights, 3, height, width), coverage.view(height, width)


def scattered_irradiance(
    head: HeadMesh,
    appearance: Appearance,
    transport: MeshTransport,
    settings: RenderSettings = RenderSettings(),
) -> np.ndarray:
    """Compute irradiance [3, V, L], direct, bounced and scattered; 1 on a surface that faces a light."""
    surface = sample(appearance, torch.from_numpy(head.part), torch.from_numpy(head.uv).float())
    albedo = surface.albedo.float().numpy()[transport.sites].T[..., None]  # [3, S, 1]
    skin = np.flatnonzero(transport.baked & (head.part == _SKIN))
    spreads = _spreads(head, skin, appearance) if settings.scattering and len(skin) else [[], [], []]
    irradiance = np.empty((3, len(head.vertices), len(transport.directions)), np.float32)
    for first in range(0, len(transport.directions), _LIGHTS):
        chunk = slice(first, first + _LIGHTS)
        total = transport.visibility[chunk].T * _cosines(head, transport.directions[chunk])
        direct = total[transport.sites]
        for channel, spread in enumerate(spreads):
            bounced = np.zeros_like(direct)
            for _ in range(settings.bounces):
                bounced = transport.gathered(albedo[channel] * (direct + bounced))
            lit = total + bounced[transport.site_of] * transport.baked[:, None]
            for step in spread:
                lit[skin] = step @ lit[skin]
            irradiance[channel, :, chunk] = lit
    return irradiance


def irradiance_factors(head: HeadMesh, transport: MeshTransport) -> tuple[np.ndarray, np.ndarray]:
    """Irradiance [V, L] straight from each light, and by one bounce off white surroundings; unscattered."""
    direct = transport.visibility.T * _cosines(head, transport.directions)
    bounced = transport.gathered(direct[transport.sites])
    return direct, bounced[transport.site_of] * transport.baked[:, None]


def _cosines(head: HeadMesh, directions: np.ndarray) -> np.ndarray:
    """Diffuse factors [V, L]: n.l clamped at 0, and `strand_cosines` on hair."""
    lights = torch.from_numpy(directions).float()
    normals = torch.from_numpy(head.normals).float()
    cosines = (normals @ lights.T).clamp_min(0)
    hair = torch.from_numpy(head.part == _HAIR)
    tangents = torch.from_numpy(head.tangents).float()[hair]
    cosines[hair] = strand_cosines(tangents, normals[hair], lights)
    return cosines.numpy()


def _spreads(head: HeadMesh, skin: np.ndarray, appearance: Appearance) -> list[list[csr_matrix]]:
    """Sparse matrices [N, N] per channel that, applied in turn, scatter light among the skin vertices [N].

    Each is a Gaussian over neighbours, weighted by their area, that face a similar direction (not across the
    gap of the lips). A wide Gaussian takes several passes of narrow ones, which have few neighbours.
    """
    third = doubled_areas(head.vertices[head.triangles].astype(np.float64)) / 6  # of a triangle's area
    area = np.bincount(head.triangles.ravel(), third.repeat(3), minlength=len(head.vertices))[skin]
    points, normals = head.vertices[skin], head.normals[skin]
    distance, near = cKDTree(points).query(points, range(1, min(_NEAR, len(skin)) + 1))
    weights = area[near] * (np.einsum("nc,nkc->nk", normals, normals[near]) > 0.3)
    reach_m = float(np.median(distance[:, -1]))
    rows = np.broadcast_to(np.arange(len(skin))[:, None], near.shape)
    result = []
    for sigma_mm in appearance.scattering_mm.tolist():
        passes = max(1, math.ceil((2.2 * sigma_mm / 1000 / reach_m) ** 2))
        sigma_m = max(sigma_mm / 1000 / math.sqrt(passes), 1e-6)
        kernel = weights * np.exp(-0.5 * (distance / sigma_m) ** 2) + 1e-12 * (distance == 0)
        kept = kernel > 1e-3 * kernel.max(1, keepdims=True)
        kernel /= (kernel * kept).sum(1, keepdims=True)
        values = kernel[kept].astype(np.float32)
        result.append([csr_matrix((values, (rows[kept], near[kept])), shape=(len(skin),) * 2)] * passes)
    return result


def _shaded(
    facets: Facets,
    directions: np.ndarray,
    visibility: np.ndarray,
    irradiance: np.ndarray,
    settings: RenderSettings,
) -> Iterator[np.ndarray]:
    """Yield the radiance [N, L] of the facets per channel; visibility [W, L] is at `facets.vertices`."""
    lights = torch.from_numpy(directions).float()
    white, coloured = torch.zeros(2, len(facets.part), len(lights))
    if settings.gloss:
        hair = facets.part == _HAIR
        lit = torch.from_numpy(facets.corners @ visibility)
        gloss = widened_lobes(
            facets.bent[~hair],
            facets.views[~hair],
            lights,
            facets.surface.specular[~hair],
            facets.surface.roughness[~hair],
            facets.spread[~hair],
        )
        white[~hair] = gloss * lit[~hair]
        strands = Strands(
            facets.tangents[hair],
            facets.views[hair],
            facets.surface.specular[hair],
            facets.surface.roughness[hair],
        )
        for lobe, radiance in zip((white, coloured), strand_highlights(strands, lights), strict=True):
            lobe[hair] = radiance * lit[hair]
    relief = _relief_ratio(facets, lights) if settings.relief else np.float32(1)
    for channel, tinted in enumerate(facets.tinted):
        diffuse = (tinted @ irradiance[channel]) * relief
        yield diffuse + (white + coloured * facets.surface.albedo[:, channel, None]).numpy()


def _relief_ratio(facets: Facets, lights: Tensor) -> np.ndarray:
    """Factor [N, L] of relief on diffuse light, to first order: ratio of cosines with and without it."""
    bent, smooth = ((n @ lights.T).clamp_min(0) for n in (facets.bent, facets.normals))
    ratio = (bent + _RELIEF_SOFTNESS) / (smooth + _RELIEF_SOFTNESS)
    ratio[facets.part == _HAIR] = 1
    return ratio.numpy()


_REFLECTANCE = 0.04  # of one surface at normal incidence: a refractive index of 1.5
_SURFACES = 2
_SHARPNESS = 150.0  # of the lobe in which a light of the rig stands for its surroundings


@dataclass(frozen=True, eq=False)
class Lenses:
    """Pixels [N] of an image [S, S], row by row, that show lenses; their normals and views [N, 3]."""

    pixels: Tensor
    normals: Tensor
    views: Tensor


def lenses_in(lenses: HeadMesh, camera: StageCamera, depth_m: np.ndarray) -> Lenses:
    """Find the pixels that show lenses before everything else, whose depth [H, W] (m) is 0 for nothing."""
    vertices = camera.to_camera(torch.from_numpy(lenses.vertices))
    triangles = torch.from_numpy(lenses.triangles)
    fragments = rasterize(vertices, triangles, camera.camera)
    normals = torch.from_numpy(lenses.normals) @ camera.head_to_camera.T
    found = interpolate(torch.cat([vertices, normals], 1), triangles, fragments)
    nothing_before = torch.from_numpy(depth_m == 0) | (-found[..., 2] < torch.from_numpy(depth_m))
    pixels = (fragments.covered & nothing_before).flatten().nonzero()[:, 0]
    place, normal = torch.split(found.flatten(0, 1)[pixels], 3, 1)
    return Lenses(pixels, F.normalize(normal, dim=1), F.normalize(-place, dim=1))


def over_lenses(images: Tensor, lenses: Lenses, directions: Tensor) -> Tensor:
    """Lay lenses over images [L, 3, H, W] of single lights, from directions [L, 3] in camera space."""
    seen, transmitted = reflections(lenses, directions)
    flat = images.flatten(2).clone()
    flat[..., lenses.pixels] = flat[..., lenses.pixels] * transmitted + seen.T[:, None]
    return flat.view_as(images)


def reflections(lenses: Lenses, directions: Tensor) -> tuple[Tensor, Tensor]:
    """Radiance [N, L] that lenses reflect of each light of a rig, and share [N] that they let through.

    A light of weight 1 stands for a cell of the sphere with a radiance of pi over its solid angle
    (docs/design.md, 'Units of light').
    """
    cosine = (lenses.normals * lenses.views).sum(1)
    mirrored = 2 * cosine[:, None] * lenses.normals - lenses.views
    share = (_SHARPNESS * mirrored @ directions.T).softmax(1)
    fresnel = _REFLECTANCE + (1 - _REFLECTANCE) * (1 - cosine.abs().clamp(0, 1)) ** 5
    reflected = _SURFACES * fresnel / (1 + fresnel)
    return reflected[:, None] * share * (len(directions) / 4), 1 - reflected
