"""Person as a stage camera sees it: samples of the surface, facets of the image, and the true layers.

Further landmarks than the 68 of `face.topology` have names: centres and outlines of the irises, and ears.
"""

from dataclasses import dataclass

import numpy as np
import torch
from scipy.sparse import csr_matrix
from torch import Tensor

from facerf_cli.portrait.parse import CLASSES, IRIS_POINTS, class_index
from facerf_cli.raster.camera import Camera, pose_to_rotation
from facerf_cli.raster.rasterize import rasterize
from facerf_cli.synth.appearance.materials import Appearance, sample
from facerf_cli.synth.appearance.people import IRIS_DEG
from facerf_cli.synth.head.mesh import PARTS, HeadMesh
from facerf_cli.synth.shading import Material, unit_along
from facerf_cli.synth.stage_settings import Frame

CAMERA_DISTANCE_M = 1.2  # from the head
# Height that an image shows at that distance, and height of its middle over the origin of the head frame.
_FRAMES_M: dict[Frame, tuple[float, float]] = {"head": (0.36, 0.0), "bust": (0.56, -0.06)}
# Azimuth and elevation of the cameras seen from the head, all in front (paper, 'Dataset').
_CAMERAS_DEG = ((0, 0), (-18, 6), (18, -6), (-36, -4), (36, 4), (-54, 3), (54, -3), (0, 24))
_SMALL_PX = 160  # images up to this side take 3 x 3 samples per pixel, larger ones 2 x 2
_NEAR = 4  # vertices of the eyeball around a point of the iris


@dataclass(frozen=True, eq=False)
class StageCamera:
    """Camera and its pose: p_camera = head_to_camera [3, 3] @ p_head + translation_m [3]."""

    camera: Camera
    head_to_camera: Tensor
    translation_m: Tensor

    def to_camera(self, points: Tensor) -> Tensor:
        """Return points [..., 3] of the head's frame in camera space."""
        return points @ self.head_to_camera.T.to(points) + self.translation_m.to(points)


def stage_cameras(size_px: int, frame: Frame = "head") -> tuple[StageCamera, ...]:
    """Build the eight cameras; world axes belong to a head that looks into the first camera."""
    high_m, middle_m = _FRAMES_M[frame]
    camera = Camera(size_px * CAMERA_DISTANCE_M / high_m, size_px, size_px, size_px / 2, size_px / 2)
    return tuple(
        StageCamera(
            camera, pose_to_rotation(-azimuth, elevation, 0), torch.tensor([0, -middle_m, -CAMERA_DISTANCE_M])
        )
        for azimuth, elevation in _CAMERAS_DEG
    )


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
        values = np.einsum("sk,skc->sc", self.weights, attribute[self.corners])
        return torch.from_numpy(values.astype(np.float32))


def surface_samples(head: HeadMesh, stage_camera: StageCamera, scale: int | None = None) -> Samples:
    """Rasterize the mesh at `scale` x `scale` samples per pixel; by default at more in small images."""
    camera = stage_camera.camera
    scale = scale or (3 if max(camera.width_px, camera.height_px) <= _SMALL_PX else 2)
    finer = Camera(
        camera.focal_px * scale,
        camera.width_px * scale,
        camera.height_px * scale,
        camera.cx_px * scale,
        camera.cy_px * scale,
    )
    vertices = stage_camera.to_camera(torch.from_numpy(head.vertices).double())
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


@dataclass(frozen=True, eq=False)
class Facets:
    """N facets of an image, one for each part in each pixel; unit vectors in the head frame."""

    vertices: np.ndarray  # [W] ids of the vertices that the image shows
    part: Tensor  # [N] index into PARTS
    corners: csr_matrix  # [N, W] mean barycentric weights; rows sum to 1
    surface: Material
    uv: Tensor  # [N, 2]
    normals: Tensor  # [N, 3] smooth normals
    bent: Tensor  # [N, 3] normals with relief
    views: Tensor  # [N, 3] directions to the camera
    tangents: Tensor  # [N, 3] of hair, toward the tip
    spread: Tensor  # [N] variance of the normals within the facet


def facets_of(
    head: HeadMesh, appearance: Appearance, camera: StageCamera, samples: Samples
) -> tuple[Facets, csr_matrix, np.ndarray]:
    """Compute the facets of an image, their share [M, N] of each covered pixel, and the pixel indices [M]."""
    part = head.part[samples.corners[:, 0]]
    groups = _Groups.of(samples.pixel * len(PARTS) + part)
    vertices, used = np.unique(samples.corners, return_inverse=True)
    weights = (samples.weights / groups.count[groups.index][:, None]).astype(np.float32)
    corners = groups.matrix(weights, used, len(vertices))
    surface = sample(appearance, torch.from_numpy(part), samples.interpolate(head.uv))
    smooth = unit_along(samples.interpolate(head.normals), 1)
    along_u, along_v = _uv_tangents(head, samples, smooth)
    slopes_u, slopes_v = torch.split(surface.relief, 1, 1)
    bent = groups.mean(unit_along(smooth - slopes_u * along_u - slopes_v * along_v, 1))
    length = bent.norm(dim=1).clamp(1e-3, 1)
    camera_head = -camera.head_to_camera.T.float() @ camera.translation_m.float()
    facets = Facets(
        vertices=vertices,
        part=torch.from_numpy(groups.keys % len(PARTS)),
        corners=corners,
        surface=surface.each(groups.mean),
        uv=groups.mean(samples.interpolate(head.uv)),
        normals=unit_along(groups.mean(smooth), 1),
        bent=unit_along(bent, 1),
        views=unit_along(camera_head - torch.from_numpy(corners @ head.vertices[vertices]), 1),
        tangents=unit_along(torch.from_numpy(corners @ head.tangents[vertices]), 1),
        spread=(1 - length) / length,
    )
    count = len(groups.keys)
    pixels, pixel_of = np.unique(groups.keys // len(PARTS), return_inverse=True)
    share = groups.count / samples.per_pixel
    return facets, csr_matrix((share, (pixel_of, np.arange(count))), shape=(len(pixels), count)), pixels


@dataclass(frozen=True, eq=False)
class _Groups:
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
        both.append(unit_along(vectors - normals * (vectors * normals).sum(1, keepdim=True), 1))
    return both[0], both[1]


def layers_of(mesh: HeadMesh, samples: Samples, camera: StageCamera) -> tuple[np.ndarray, np.ndarray]:
    """Return the fraction of each class in a pixel [H, W, len(CLASSES)], and depth [H, W] in m or 0.

    With the background the fractions sum to 1. A sample has the class of its nearest vertex.
    """
    height, width = camera.camera.height_px, camera.camera.width_px
    nearest = samples.corners[np.arange(len(samples.pixel)), samples.weights.argmax(1)]
    key = samples.pixel * len(CLASSES) + mesh.label[nearest]
    classes = np.bincount(key, minlength=height * width * len(CLASSES)) / samples.per_pixel
    classes = classes.reshape(height, width, -1).astype(np.float32)
    classes[..., class_index("background")] = 1 - classes.sum(-1)
    depth_m = -camera.to_camera(samples.interpolate(mesh.vertices))[:, 2].numpy()
    total_m = np.bincount(samples.pixel, depth_m, height * width)
    count = np.bincount(samples.pixel, minlength=height * width)
    return classes, (total_m / np.maximum(count, 1)).reshape(height, width).astype(np.float32)


def more_landmarks(mesh: HeadMesh) -> dict[str, np.ndarray]:
    """Return points [3] by name on irises and ears, in the head frame; left and right are the image's."""
    points: dict[str, np.ndarray] = {}
    sides = {"left": -1, "right": 1}
    for side, sign in sides.items():
        points |= {f"{side} {name}": place for name, place in _iris(mesh, sign).items()}
        ear = mesh.vertices[(mesh.label == class_index("ears")) & (mesh.vertices[:, 0] * sign > 0)]
        if len(ear):
            ends = {"top": ear[:, 1].argmax(), "lobe": ear[:, 1].argmin(), "back": ear[:, 2].argmin()}
            points |= {f"{side} ear {name}": ear[index] for name, index in ends.items()}
    return points


def _iris(mesh: HeadMesh, sign: int) -> dict[str, np.ndarray]:
    """Centre and outline of the iris on one side: means of the nearest vertices by the eyeball's texture."""
    ball = np.flatnonzero((mesh.is_part("eye")) & (mesh.vertices[:, 0] * sign > 0))
    turn = np.arange(IRIS_POINTS) / IRIS_POINTS * 2 * np.pi
    ring = 0.5 + IRIS_DEG / 180 * np.stack([np.cos(turn), -np.sin(turn)], -1)
    points = {}
    for name, uv in {"iris": np.array([0.5, 0.5]), **{f"iris {k}": at for k, at in enumerate(ring)}}.items():
        distance = np.linalg.norm(mesh.uv[ball] - uv, axis=-1)
        near = distance.argsort()[:_NEAR]
        weights = 1 / (distance[near] + 1e-4)
        points[name] = (mesh.vertices[ball[near]] * (weights / weights.sum())[:, None]).sum(0)
    return points
