"""A person as a stage camera sees it: samples of the surface, facets of the image, and the true layers.

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
from facerf_cli.synth.head.mesh import PARTS, HeadMesh, unit
from facerf_cli.synth.shading import Material, unit_along
from facerf_cli.synth.stage_settings import Frame

CAMERA_DISTANCE_M = 1.2  # from the head
# Height that an image shows at that distance, and height of its middle over the origin of the head frame.
_FRAMES_M: dict[Frame, tuple[float, float]] = {"head": (0.36, 0.0), "bust": (0.56, -0.06)}
# Azimuth and elevation of the cameras seen from the head, all in front (paper, 'Dataset').
_CAMERAS_DEG = ((0, 0), (-18, 6), (18, -6), (-36, -4), (36, 4), (-54, 3), (54, -3), (0, 24))


@dataclass(frozen=True, eq=False)
class StageCamera:
    """A camera and its pose: p_camera = head_to_camera [3, 3] @ p_head + translation_m [3]."""

    camera: Camera
    head_to_camera: Tensor
    translation_m: Tensor

    def to_camera(self, points: Tensor) -> Tensor:
        """Points [..., 3] of the head's frame in camera space."""
        return points @ self.head_to_camera.T.to(points) + self.translation_m.to(points)


def stage_cameras(size_px: int, frame: Frame = "head") -> tuple[StageCamera, ...]:
    """Build the eight cameras; world axes are those of a head that looks into the first camera."""
    high_m, middle_m = _FRAMES_M[frame]
    camera = Camera(size_px * CAMERA_DISTANCE_M / high_m, size_px, size_px, size_px / 2, size_px / 2)
    return tuple(
        StageCamera(
            camera, pose_to_rotation(-azimuth, elevation, 0), torch.tensor([0, -middle_m, -CAMERA_DISTANCE_M])
        )
        for azimuth, elevation in _CAMERAS_DEG
    )


_SMALL_PX = 160  # images up to this side take 3 x 3 samples per pixel, larger ones 2 x 2


@dataclass(frozen=True, eq=False)
class Facets:
    """N facets of an image, one for each part in each pixel; unit vectors in the head frame."""

    vertices: np.ndarray  # [W] ids of the vertices that the image shows
    part: Tensor  # [N] index into PARTS
    corners: csr_matrix  # [N, W] mean barycentric weights; rows sum to 1
    tinted: list[csr_matrix]  # per channel [N, V]: weights times albedo
    surface: Material
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
            self.surface.part(rows),
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
    smooth = unit_along(samples.interpolate(head.normals), 1)
    along_u, along_v = _uv_tangents(head, samples, smooth)
    slopes = surface.relief if relief else torch.zeros(len(part), 2)
    bent = groups.mean(unit_along(smooth - slopes[:, :1] * along_u - slopes[:, 1:] * along_v, 1))
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


_SAMPLES = 3  # along each side of a pixel
_NEAR = 4  # vertices of the eyeball around a point of the iris


@dataclass(frozen=True, eq=False)
class Truth:
    """Layers [H, W] or [H, W, C] float32 of an image; surface and material are means over what is covered."""

    classes: np.ndarray  # [H, W, len(CLASSES)] share of each in a pixel; with the background their sum is 1
    albedo: np.ndarray  # linear Rec.709
    normals: np.ndarray  # unit, camera space
    positions_m: np.ndarray  # camera space
    specular: np.ndarray  # reflectance at normal incidence
    roughness: np.ndarray  # of the highlight

    @property
    def alpha(self) -> np.ndarray:
        """Share [H, W] of each pixel that shows the person."""
        return np.asarray(1 - self.classes[..., class_index("background")])


def truth_of(mesh: HeadMesh, appearance: Appearance, camera: StageCamera) -> Truth:
    """Compute the layers of the image that a camera takes of a person."""
    samples = surface_samples(mesh, camera, _SAMPLES)
    height, width = camera.camera.height_px, camera.camera.width_px
    part = torch.from_numpy(mesh.part[samples.corners[:, 0]])
    material = sample(appearance, part, samples.interpolate(mesh.uv))
    rotation, shift = camera.head_to_camera.numpy(), camera.translation_m.numpy()
    surface = np.concatenate(
        [
            material.albedo.numpy(),
            unit(samples.interpolate(mesh.normals).numpy()) @ rotation.T,
            samples.interpolate(mesh.vertices).numpy() @ rotation.T + shift,
            material.specular.numpy()[:, None],
            material.roughness.numpy()[:, None],
        ],
        1,
    )
    count = np.bincount(samples.pixel, minlength=height * width)
    totals = [np.bincount(samples.pixel, column, height * width) for column in surface.T]
    means = (np.stack(totals, -1) / np.maximum(count, 1)[:, None]).reshape(height, width, -1)
    albedo, normals, positions, gloss = np.split(means.astype(np.float32), [3, 6, 9], -1)
    classes = _class_shares(mesh, samples, height * width).reshape(height, width, -1)
    return Truth(classes, albedo, unit(normals), positions, gloss[..., 0], gloss[..., 1])


def _class_shares(mesh: HeadMesh, samples: Samples, pixels: int) -> np.ndarray:
    """Share [N, len(CLASSES)] of each class in each pixel, by the nearest vertex of every sample."""
    nearest = samples.corners[np.arange(len(samples.pixel)), samples.weights.argmax(1)]
    key = samples.pixel * len(CLASSES) + mesh.label[nearest]
    shares = np.bincount(key, minlength=pixels * len(CLASSES)).reshape(pixels, -1) / samples.per_pixel
    shares[:, class_index("background")] = 1 - shares.sum(1)
    return shares.astype(np.float32)


def more_landmarks(mesh: HeadMesh) -> dict[str, np.ndarray]:
    """Places [3] by name on irises and ears of a mesh in the head frame; left and right are the image's."""
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
    found = {}
    for name, uv in {"iris": np.array([0.5, 0.5]), **{f"iris {k}": at for k, at in enumerate(ring)}}.items():
        distance = np.linalg.norm(mesh.uv[ball] - uv, axis=-1)
        near = distance.argsort()[:_NEAR]
        weights = 1 / (distance[near] + 1e-4)
        found[name] = (mesh.vertices[ball[near]] * (weights / weights.sum())[:, None]).sum(0)
    return found
