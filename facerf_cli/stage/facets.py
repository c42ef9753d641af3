"""What the pixels of a camera see of a head's mesh: facets, one for each part of the mesh in a pixel."""

from dataclasses import dataclass, fields

import numpy as np
import torch
from scipy.sparse import csr_matrix
from torch import Tensor

from facerf_cli.raster.camera import Camera
from facerf_cli.raster.rasterize import rasterize
from facerf_cli.stage.appearance.materials import Appearance, Surface, sample
from facerf_cli.stage.head.mesh import PARTS, HeadMesh
from facerf_cli.stage.shading import unit
from facerf_cli.stage.stage_camera import StageCamera

_SMALL_PX = 160  # a picture up to this side takes 3 x 3 samples a pixel, a larger one 2 x 2


@dataclass(frozen=True, eq=False)
class Facets:
    """What a picture's pixels see [N], one entry for each part in a pixel; vectors in the head frame."""

    vertices: np.ndarray  # [W] that the picture shows
    part: Tensor  # [N]
    corners: csr_matrix  # [N, W] barycentric weights; rows sum to 1
    tinted: list[csr_matrix]  # [N, V] a channel: those times albedo
    surface: Surface
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
            Surface(*(getattr(self.surface, field.name)[rows] for field in fields(Surface))),
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
        surface=Surface(*(mean(getattr(surface, field.name)) for field in fields(Surface))),
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
