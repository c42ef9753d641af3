"""What the pixels of a camera see of a head's mesh: facets, one for each part of the mesh in a pixel.

Photographs of a synthetic head under one light at a time, from its baked transport.

Light is kept at the mesh's vertices and a camera sees samples of the mesh, so all pictures of a camera are
one sparse product a channel: area x albedo x barycentric weights [facets of the picture, V] times irradiance
[V, L]. Highlights are shaded per facet. A facet is what one pixel sees of one part.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass, fields

import numpy as np
import torch
from scipy.sparse import csr_matrix
from scipy.spatial import cKDTree
from torch import Tensor

from facerf_cli.light.mesh_transport import MeshTransport
from facerf_cli.raster.camera import Camera
from facerf_cli.raster.rasterize import rasterize
from facerf_cli.synth.appearance.materials import Appearance, MaterialPoints, sample
from facerf_cli.synth.head.mesh import PARTS, HeadMesh
from facerf_cli.synth.shading import Cosines, Strands, strand_cosines, strand_highlights, two_lobes, unit
from facerf_cli.synth.views import StageCamera

_SMALL_PX = 160  # a picture up to this side takes 3 x 3 samples a pixel, a larger one 2 x 2


@dataclass(frozen=True, eq=False)
class Facets:
    """What a picture's pixels see [N], one entry for each part in a pixel; vectors in the head frame."""

    vertices: np.ndarray  # [W] that the picture shows
    part: Tensor  # [N]
    corners: csr_matrix  # [N, W] barycentric weights; rows sum to 1
    tinted: list[csr_matrix]  # [N, V] a channel: those times albedo
    surface: MaterialPoints
    normals: Tensor  # [N, 3] unit, as are the rest
    bent: Tensor
    views: Tensor
    tangents: Tensor
    spread: Tensor  # [N] variance of the normals within

    def part_of(self, rows: slice) -> "Facets":
        """Some of the facets."""
        return Facets(
            self.vertices,
            self.part[rows],
            self.corners[rows],
            [matrix[rows] for matrix in self.tinted],
            MaterialPoints(*(getattr(self.surface, field.name)[rows] for field in fields(MaterialPoints))),
            *(getattr(self, name)[rows] for name in ("normals", "bent", "views", "tangents", "spread")),
        )


def facets_of(
    head: HeadMesh, appearance: Appearance, camera: StageCamera, relief: bool
) -> tuple[Facets, csr_matrix, np.ndarray]:
    """The facets of a picture, the area [M, N] that each has of its covered pixels, and these pixels [M].

    Without `relief` bumps do not bend their normals.
    """
    samples = _samples(head, camera)
    part = head.part[samples.corners[:, 0]]
    key, facet = np.unique(samples.pixel * len(PARTS) + part, return_inverse=True)
    number = np.bincount(facet, minlength=len(key)).astype(np.float32)
    vertices, used = np.unique(samples.corners, return_inverse=True)
    each = (samples.weights / number[facet][:, None]).astype(np.float32)
    rows = facet.repeat(3)
    corners = csr_matrix((each.ravel(), (rows, used.ravel())), shape=(len(key), len(vertices)))

    def interpolated(attribute: np.ndarray) -> Tensor:
        found = np.einsum("sk,skc->sc", samples.weights, attribute[samples.corners])
        return torch.from_numpy(found.astype(np.float32))

    def tinted(albedo: Tensor) -> csr_matrix:
        values = each * albedo.numpy()[:, None]
        return csr_matrix((values.ravel(), (rows, samples.corners.ravel())), shape=(len(key), len(head.part)))

    def mean(values: Tensor) -> Tensor:
        total = torch.zeros(len(key), *values.shape[1:]).index_add_(0, torch.from_numpy(facet), values)
        return total / torch.from_numpy(number).view(-1, *[1] * (values.dim() - 1))

    surface = sample(appearance, torch.from_numpy(part), interpolated(head.uv))
    smooth = unit(interpolated(head.normals), 1)
    along_u, along_v = _uv_tangents(head, samples, smooth)
    slopes = surface.relief if relief else torch.zeros(len(part), 2)
    bent = mean(unit(smooth - slopes[:, :1] * along_u - slopes[:, 1:] * along_v, 1))
    length = bent.norm(dim=1).clamp(1e-3, 1)
    eye_head = -camera.head_to_camera.T.float() @ camera.translation_m.float()
    facets = Facets(
        vertices=vertices,
        part=torch.from_numpy(key % len(PARTS)),
        corners=corners,
        tinted=[tinted(channel) for channel in surface.albedo.T],
        surface=MaterialPoints(*(mean(getattr(surface, field.name)) for field in fields(MaterialPoints))),
        normals=unit(mean(smooth), 1),
        bent=unit(bent, 1),
        views=unit(eye_head - torch.from_numpy(corners @ head.vertices[vertices]), 1),
        tangents=unit(torch.from_numpy(corners @ head.tangents[vertices]), 1),
        spread=(1 - length) / length,
    )
    pixels, pixel_of = np.unique(key // len(PARTS), return_inverse=True)
    area = csr_matrix(
        (number / samples.per_pixel, (pixel_of, np.arange(len(key)))), shape=(len(pixels), len(key))
    )
    return facets, area, pixels


@dataclass(frozen=True, eq=False)
class _Samples:
    """The mesh's points [S] that are seen, several to a pixel."""

    pixel: np.ndarray
    triangle: np.ndarray
    corners: np.ndarray  # [S, 3] vertices
    weights: np.ndarray  # [S, 3] barycentric
    per_pixel: int


def _samples(head: HeadMesh, stage_camera: StageCamera) -> _Samples:
    camera = stage_camera.camera
    scale = 3 if max(camera.width_px, camera.height_px) <= _SMALL_PX else 2
    finer = Camera(
        camera.focal_px * scale,
        camera.width_px * scale,
        camera.height_px * scale,
        camera.cx_px * scale,
        camera.cy_px * scale,
    )
    rotation, translation = stage_camera.head_to_camera.double(), stage_camera.translation_m.double()
    vertices = torch.from_numpy(head.vertices).double() @ rotation.T + translation
    fragments = rasterize(vertices, torch.from_numpy(head.triangles), finer)
    row, column = (index.numpy() for index in torch.nonzero(fragments.covered, as_tuple=True))
    triangle = fragments.triangle.numpy()[row, column]
    return _Samples(
        pixel=(row // scale) * camera.width_px + column // scale,
        triangle=triangle,
        corners=head.triangles[triangle],
        weights=fragments.barycentric.numpy()[row, column],
        per_pixel=scale * scale,
    )


def _uv_tangents(head: HeadMesh, samples: _Samples, normals: Tensor) -> tuple[Tensor, Tensor]:
    """Unit directions [S, 3] in which u and v grow along the surface; 0 where the texture does not vary."""
    used, inverse = np.unique(samples.triangle, return_inverse=True)
    corners = head.triangles[used]
    points, uv = head.vertices[corners].astype(np.float64), head.uv[corners].astype(np.float64)
    (side_1, side_2), (du_dv_1, du_dv_2) = ((x[:, 1] - x[:, 0], x[:, 2] - x[:, 0]) for x in (points, uv))
    along_u = side_1 * du_dv_2[:, 1:] - side_2 * du_dv_1[:, 1:]
    along_v = side_2 * du_dv_1[:, :1] - side_1 * du_dv_2[:, :1]
    turn = np.sign(du_dv_1[:, :1] * du_dv_2[:, 1:] - du_dv_1[:, 1:] * du_dv_2[:, :1])
    both = []
    for along in (along_u, along_v):
        length = np.linalg.norm(along, axis=1, keepdims=True)
        vectors = torch.from_numpy(along * turn / np.where(length > 0, length, 1)).float()[inverse]
        both.append(unit(vectors - normals * (vectors * normals).sum(1, keepdim=True), 1))
    return both[0], both[1]


_SKIN, _HAIR = PARTS.index("skin"), PARTS.index("hair")
_CHUNK = 1 << 19  # pixels x lights that are shaded at a time: what fits the caches
_LIGHTS = 25  # that are bounced at a time
_NEAR = 32  # vertices that one pass of scattering reaches
_RELIEF_SOFTNESS = 0.15  # light from the sides (scattering, bounces) that keeps bumps from going black
_NORMAL_VARIANCE = 0.18  # at most, added to alpha squared where a pixel's normals spread


@dataclass(frozen=True)
class RenderSettings:
    """What light does beyond the first hit; `gloss` and `relief` may be left out to compare renderers."""

    bounces: int = 2
    scattering: bool = True
    gloss: bool = True
    relief: bool = True


def photograph(
    head: HeadMesh,
    appearance: Appearance,
    transport: MeshTransport,
    camera: StageCamera,
    settings: RenderSettings = RenderSettings(),
    irradiance: np.ndarray | None = None,
) -> tuple[Tensor, Tensor]:
    """Pictures [L, 3, H, W] linear float32, one for each light of rgb 1, and coverage [H, W] in 0..1.

    `irradiance` is what `scattered_irradiance` returned for the same head: with several cameras it need be
    computed only once.
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
    """Irradiance [3, V, L]: direct, bounced and spread under the skin; 1 on what faces a light of rgb 1."""
    albedo = _vertex_albedo(head, appearance)[transport.sites].T[..., None]  # [3, S, 1]
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


def _cosines(head: HeadMesh, directions: np.ndarray) -> np.ndarray:
    """n.l [V, L] clamped at 0, and what stands in for it on hair."""
    lights = torch.from_numpy(directions).float()
    normals = torch.from_numpy(head.normals).float()
    cosines = (normals @ lights.T).clamp_min(0)
    hair = torch.from_numpy(head.part == _HAIR)
    tangents = torch.from_numpy(head.tangents).float()[hair]
    cosines[hair] = strand_cosines(tangents, normals[hair], lights)
    return cosines.numpy()


def _vertex_albedo(head: HeadMesh, appearance: Appearance) -> np.ndarray:
    surface = sample(appearance, torch.from_numpy(head.part), torch.from_numpy(head.uv).float())
    return surface.albedo.float().numpy()


def _spreads(head: HeadMesh, skin: np.ndarray, appearance: Appearance) -> list[list[csr_matrix]]:
    """For each channel the sparse means [N, N] that, one after the other, spread light under the skin [N].

    A Gaussian over near vertices, weighted by their area, among skin that faces alike (not across the lips'
    slit). A wide one takes several passes of narrower ones, so that each reaches few vertices.
    """
    area = _vertex_areas_m2(head)[skin]
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


def _vertex_areas_m2(head: HeadMesh) -> np.ndarray:
    a, b, c = (head.vertices[head.triangles[:, k]].astype(np.float64) for k in range(3))
    third = np.linalg.norm(np.cross(b - a, c - a), axis=1) / 6
    return np.bincount(head.triangles.ravel(), third.repeat(3), minlength=len(head.vertices))


def _shaded(
    facets: Facets,
    directions: np.ndarray,
    visibility: np.ndarray,
    irradiance: np.ndarray,
    settings: RenderSettings,
) -> Iterator[np.ndarray]:
    """Radiance [N, L] of the facets by channel; visibility is that of `facets.vertices` [W, L]."""
    lights = torch.from_numpy(directions).float()
    white, coloured = torch.zeros(2, len(facets.part), len(lights))
    if settings.gloss:
        hair = facets.part == _HAIR
        seen = torch.from_numpy(facets.corners @ visibility)
        white[~hair] = _gloss(facets, ~hair, lights) * seen[~hair]
        strands = Strands(
            facets.tangents[hair],
            facets.views[hair],
            facets.surface.specular[hair],
            facets.surface.roughness[hair],
        )
        for lobe, radiance in zip((white, coloured), strand_highlights(strands, lights), strict=True):
            lobe[hair] = radiance * seen[hair]
    relief = _relief_ratio(facets, lights) if settings.relief else np.float32(1)
    for channel, tinted in enumerate(facets.tinted):
        diffuse = (tinted @ irradiance[channel]) * relief
        yield diffuse + (white + coloured * facets.surface.albedo[:, channel, None]).numpy()


def _gloss(facets: Facets, chosen: Tensor, lights: Tensor) -> Tensor:
    """Unshadowed highlights [n, L] of the chosen facets [N] bool.

    Where normals spread within a pixel, their variance widens the lobe (Tokuyoshi and Kaplanyan, *Improved
    geometric specular antialiasing*, 2019).
    """
    normals, views = facets.bent[chosen], facets.views[chosen]
    l_dot_v = views @ lights.T
    to_half = (2 + 2 * l_dot_v).clamp_min(1e-6).rsqrt()
    n_dot_l, n_dot_v = normals @ lights.T, (normals * views).sum(1, keepdim=True)
    cosines = Cosines(
        n_dot_l=n_dot_l.clamp_min(0),
        n_dot_v=n_dot_v.clamp_min(0.05),
        n_dot_h=((n_dot_l + n_dot_v) * to_half).clamp(0, 1),
        v_dot_h=((1 + l_dot_v) * to_half).clamp(0, 1),
    )
    widened = facets.surface.roughness[chosen] ** 4 + (2 * facets.spread[chosen]).clamp_max(_NORMAL_VARIANCE)
    return two_lobes(cosines, facets.surface.specular[chosen, None], widened[:, None] ** 0.25)


def _relief_ratio(facets: Facets, lights: Tensor) -> np.ndarray:
    """What bumps make of the diffuse light [N, L], to first order: the ratio of cosines with and without."""
    bent, smooth = ((n @ lights.T).clamp_min(0) for n in (facets.bent, facets.normals))
    ratio = (bent + _RELIEF_SOFTNESS) / (smooth + _RELIEF_SOFTNESS)
    ratio[facets.part == _HAIR] = 1
    return ratio.numpy()
