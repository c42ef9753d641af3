"""Facets: the parts of a head's mesh that each pixel of a camera shows, for the bake renderer."""

from dataclasses import dataclass, fields

import numpy as np
import torch
from scipy.sparse import csr_matrix
from torch import Tensor

from facerf_cli.raster.camera import Camera
from facerf_cli.raster.rasterize import rasterize
from facerf_cli.synth.appearance.materials import Appearance, MaterialPoints, sample
from facerf_cli.synth.head.mesh import PARTS, HeadMesh
from facerf_cli.synth.shading import unit
from facerf_cli.synth.stage_cameras import StageCamera

_SMALL_PX = 160  # images up to this side take 3 x 3 samples per pixel, larger ones 2 x 2


@dataclass(frozen=True, eq=False)
class Facets:
    """N facets of an image, one for each part in each pixel; unit vectors in the head frame."""

    vertices: np.ndarray  # [W] ids of the vertices that the image shows
    part: Tensor  # [N] index into PARTS
    corners: csr_matrix  # [N, W] mean barycentric weights; rows sum to 1
    tinted: list[csr_matrix]  # per channel [N, V]: weights times albedo
    surface: MaterialPoints
    uv: Tensor  # [N, 2]
    normals: Tensor  # [N, 3] smooth normals
    bent: Tensor  # [N, 3] normals with relief
    views: Tensor  # [N, 3] directions to the camera
    tangents: Tensor  # [N, 3] of hair, toward the tip
    spread: Tensor  # [N] variance of the normals within the facet

    def part_of(self, rows: slice) -> "Facets":
        """Select rows of the facets."""
        return Facets(
            self.vertices,
            self.part[rows],
            self.corners[rows],
            [matrix[rows] for matrix in self.tinted],
            MaterialPoints(*(getattr(self.surface, field.name)[rows] for field in fields(MaterialPoints))),
            *(getattr(self, name)[rows] for name in ("uv", "normals", "bent", "views", "tangents", "spread")),
        )


def facets_of(
    head: HeadMesh, appearance: Appearance, camera: StageCamera, relief: bool
) -> tuple[Facets, csr_matrix, np.ndarray]:
    """Compute the facets of an image, their share [M, N] of each covered pixel, and the pixel indices [M].

    `relief` tilts the normals by the fine relief of the materials.
    """
    small = max(camera.camera.width_px, camera.camera.height_px) <= _SMALL_PX
    samples = surface_samples(head, camera, 3 if small else 2)
    part = head.part[samples.corners[:, 0]]
    groups = _Groups.of(samples.pixel * len(PARTS) + part)
    vertices, used = np.unique(samples.corners, return_inverse=True)
    weights = (samples.weights / groups.count[groups.index][:, None]).astype(np.float32)
    corners = groups.matrix(weights, used, len(vertices))
    surface = sample(appearance, torch.from_numpy(part), samples.interpolate(head.uv))
    smooth = unit(samples.interpolate(head.normals), 1)
    along_u, along_v = _uv_tangents(head, samples, smooth)
    slopes = surface.relief if relief else torch.zeros(len(part), 2)
    bent = groups.mean(unit(smooth - slopes[:, :1] * along_u - slopes[:, 1:] * along_v, 1))
    length = bent.norm(dim=1).clamp(1e-3, 1)
    camera_head = -camera.head_to_camera.T.float() @ camera.translation_m.float()
    facets = Facets(
        vertices=vertices,
        part=torch.from_numpy(groups.keys % len(PARTS)),
        corners=corners,
        tinted=[
            groups.matrix(weights * albedo.numpy()[:, None], samples.corners, len(head.part))
            for albedo in surface.albedo.T
        ],
        surface=MaterialPoints(
            *(groups.mean(getattr(surface, field.name)) for field in fields(MaterialPoints))
        ),
        uv=groups.mean(samples.interpolate(head.uv)),
        normals=unit(groups.mean(smooth), 1),
        bent=unit(bent, 1),
        views=unit(camera_head - torch.from_numpy(corners @ head.vertices[vertices]), 1),
        tangents=unit(torch.from_numpy(corners @ head.tangents[vertices]), 1),
        spread=(1 - length) / length,
    )
    count = len(groups.keys)
    pixels, pixel_of = np.unique(groups.keys // len(PARTS), return_inverse=True)
    share = groups.count / samples.per_pixel
    return facets, csr_matrix((share, (pixel_of, np.arange(count))), shape=(len(pixels), count)), pixels


@dataclass(frozen=True, eq=False)
class Samples:
    """S visible points of the mesh, several per pixel."""

    pixel: np.ndarray  # [S]
    triangle: np.ndarray  # [S]
    corners: np.ndarray  # [S, 3] vertex ids
    weights: np.ndarray  # [S, 3] barycentric
    per_pixel: int

    def interpolate(self, attribute: np.ndarray) -> Tensor:
        """Interpolate an attribute of the vertices [V, C] at the points [S, C]."""
        found = np.einsum("sk,skc->sc", self.weights, attribute[self.corners])
        return torch.from_numpy(found.astype(np.float32))


@dataclass(frozen=True, eq=False)
class _Groups:
    """Grouping of S samples into N facets."""

    keys: np.ndarray  # [N] key of each facet, ascending
    index: np.ndarray  # [S] facet of each sample
    count: np.ndarray  # [N] samples in each facet, float32

    @staticmethod
    def of(keys: np.ndarray) -> "_Groups":
        """Group samples by their keys [S]."""
        unique, index = np.unique(keys, return_inverse=True)
        return _Groups(unique, index, np.bincount(index, minlength=len(unique)).astype(np.float32))

    def mean(self, values: Tensor) -> Tensor:
        """Average values [S, ...] over each facet [N, ...]."""
        total = torch.zeros(len(self.keys), *values.shape[1:])
        total = total.index_add_(0, torch.from_numpy(self.index), values)
        return total / torch.from_numpy(self.count).view(-1, *[1] * (values.dim() - 1))

    def matrix(self, values: np.ndarray, columns: np.ndarray, width: int) -> csr_matrix:
        """Sum values [S, 3] in given columns into the rows of the facets [N, width]."""
        rows = self.index.repeat(3)
        return csr_matrix((values.ravel(), (rows, columns.ravel())), shape=(len(self.keys), width))


def surface_samples(head: HeadMesh, stage_camera: StageCamera, scale: int) -> Samples:
    """Rasterize the mesh at `scale` x `scale` samples per pixel."""
    camera = stage_camera.camera
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
    return Samples(
        pixel=(row // scale) * camera.width_px + column // scale,
        triangle=triangle,
        corners=head.triangles[triangle],
        weights=fragments.barycentric.numpy()[row, column],
        per_pixel=scale * scale,
    )


def _uv_tangents(head: HeadMesh, samples: Samples, normals: Tensor) -> tuple[Tensor, Tensor]:
    """Unit tangents [S, 3] along u and v of the surface; 0 where u and v are constant."""
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
