"""Import a published face model: resample it from its publisher's topology to the canonical grid.

The model's landmarks warp the grid in UV space; rays through the warped grid locate its surface.
"""

from pathlib import Path

import numpy as np
import torch
import trimesh
from scipy.interpolate import RBFInterpolator
from scipy.ndimage import binary_dilation, median_filter
from scipy.sparse import csr_matrix
from scipy.spatial import cKDTree
from scipy.spatial.distance import cdist

from facerf_cli.errors import InputError
from facerf_cli.face.importers.basel import read_basel
from facerf_cli.face.importers.flame import read_flame
from facerf_cli.face.importers.ict import read_ict_facekit
from facerf_cli.face.importers.source import SourceModel
from facerf_cli.face.morphable import MorphableModel, load_face_model
from facerf_cli.face.topology import (
    GRID,
    LANDMARK_UV,
    LANDMARKS_M,
    OUTER_EYE_CORNERS,
    cylinder_rays,
    cylinder_uv,
    grid_uv,
    landmark_weights,
)

_HEAD_M, _EYES_M = (0.12, 1.0), (0.06, 0.13)  # lengths outside these ranges are in another unit
_SLIP_M = 0.006  # a ray that ends this far behind its neighbours slipped between the lips or lids
_CANDIDATES = 12  # triangles, those with the nearest centres, in which the nearest point is searched
_PULL_M = 0.005  # radius around a landmark within which the grid is pulled onto it
_FEWEST_LANDMARKS = 12
_LEAST_COVERED = 0.75  # fraction of the grid that the model's surface must cover


def import_face_model(path: Path, landmarks: Path | None = None) -> MorphableModel:
    """Import a published model: FLAME from .pkl or .npz, Basel from .mat or .h5, ICT-FaceKit otherwise.

    `landmarks` is FLAME's landmark embedding. Raises InputError for files that cannot be imported.
    """
    source = _read(path, landmarks)
    try:
        return resample_model(source)
    except InputError as error:
        raise InputError(f"{path}: {error}") from None


def _read(path: Path, landmarks: Path | None) -> SourceModel:
    suffix = path.suffix.lower()
    if suffix in (".pkl", ".npz"):
        return read_flame(path, landmarks)
    if landmarks is not None:
        raise InputError(f"{landmarks}: --landmarks is for FLAME, but {path} is not; remove it")
    return read_basel(path) if suffix in (".mat", ".h5") else read_ict_facekit(path)


def resample_model(source: SourceModel) -> MorphableModel:
    """Resample a model to the canonical topology.

    A model without expressions uses the built-in model's, which have the same vertices. A surface that ends
    inside the grid, such as Basel's face12, is continued by the built-in face, which follows its border.
    Raises InputError for a mean in another unit, and for a model that names too few landmarks.
    """
    side_m = float(np.ptp(source.mean[np.unique(source.triangles)], 0).max())
    _require_size("its mean's largest side", side_m, _HEAD_M)
    known = source.known
    if len(known) < _FEWEST_LANDMARKS or not known.keys() >= set(OUTER_EYE_CORNERS):
        raise InputError(f"it names only {len(known)} of the landmarks; use the file as published")
    eyes_m = float(np.linalg.norm(known[OUTER_EYE_CORNERS[0]] - known[OUTER_EYE_CORNERS[1]]))
    _require_size("the distance of its eyes' outer corners", eyes_m, _EYES_M)
    numbers = sorted(known)
    landmarks = np.stack([known[number] for number in numbers])
    rotation, translation = rigid_alignment(landmarks, LANDMARKS_M[numbers])
    mean = source.mean @ rotation.T + translation
    moved = landmarks @ rotation.T + translation
    corners, weights, covered = register(mean, source.triangles, moved, numbers)
    rows = np.arange(0, corners.size + 1, 3)
    onto_grid = csr_matrix((weights.ravel(), corners.ravel(), rows), (len(corners), len(mean)))
    builtin, (border, weights_beyond) = load_face_model(), _beyond(covered)

    def resampled(field: np.ndarray, otherwise: np.ndarray | float = 0.0) -> torch.Tensor:
        off = onto_grid @ field - otherwise
        off[~covered] = weights_beyond @ off[border]
        return torch.from_numpy((off + otherwise).astype(np.float32))

    def resampled_basis(basis: np.ndarray) -> torch.Tensor:
        return torch.stack([resampled(shape @ rotation.T) for shape in basis])

    has_expressions = len(source.expression) > 0
    return MorphableModel(
        name=source.name,
        licence=source.licence + ("" if has_expressions else f"; expressions: {builtin.licence}"),
        mean=resampled(mean, builtin.mean.double().numpy()),
        identity=resampled_basis(source.identity),
        expression=resampled_basis(source.expression) if has_expressions else builtin.expression,
        expression_names=source.expression_names if has_expressions else builtin.expression_names,
    )


def _require_size(what: str, length_m: float, between_m: tuple[float, float]) -> None:
    if not between_m[0] < length_m < between_m[1]:
        raise InputError(f"{what} is {1000 * length_m:.4g} mm; use the model in its published unit")


def _beyond(covered: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the border [V] of the covered vertices [V], and its weights [M, B] at the uncovered ones.

    The weights are inverse distances: exact at the border, smooth beyond.
    """
    border = covered & binary_dilation(~covered.reshape(GRID, GRID)).ravel()
    grid = grid_uv().double().numpy()
    pull = 1 / (cdist(grid[~covered], grid[border]) ** 4 + 1e-12)
    return border, pull / pull.sum(-1, keepdims=True)


def register(
    mean: np.ndarray, triangles: np.ndarray, landmarks: np.ndarray, numbers: list[int]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Locate the canonical vertices on a mesh; return vertex ids and weights [V, 3], and coverage [V].

    A thin-plate spline of the displacements of the landmarks [K, 3] of these numbers [K] from their canonical
    (u, v) warps the grid. Coverage is true where the mesh covers a vertex.
    """
    canonical = LANDMARK_UV[numbers]
    warp = RBFInterpolator(canonical, cylinder_uv(landmarks) - canonical, kernel="thin_plate_spline")
    uv = grid_uv().double().numpy()
    mesh = trimesh.Trimesh(mean, triangles, process=False)
    points, covered = _cast(mesh, *cylinder_rays(uv + warp(uv)))
    points, faces = nearest_on_mesh(mesh, _pulled(points, landmarks, numbers))
    weights = trimesh.triangles.points_to_barycentric(mesh.triangles[faces], points)
    weights = np.clip(weights, 0, None)
    return triangles[faces], weights / weights.sum(-1, keepdims=True), covered


def _cast(
    mesh: trimesh.Trimesh, origins: np.ndarray, directions: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Intersect the grid's rays with the mesh; return the points [V, 3] and a mask [V] of the hits.

    A ray that slips into a slit ends at the distance of its neighbours.
    """
    points, rays, _ = mesh.ray.intersects_location(origins, directions, multiple_hits=False)
    if len(rays) < len(origins) * _LEAST_COVERED:
        raise InputError(
            f"its surface covers {100 * len(rays) / len(origins):.0f} % of the face, from the forehead to "
            f"below the chin; {100 * _LEAST_COVERED:.0f} % are needed; use the model's larger mesh"
        )
    distance_m = np.full(len(origins), np.inf)
    distance_m[rays] = np.linalg.norm(points - origins[rays], axis=-1)
    filled = np.where(np.isfinite(distance_m), distance_m, distance_m[rays].max())
    median_m = median_filter(filled.reshape(GRID, GRID), 5).ravel()
    ends = origins + directions * np.where(distance_m < median_m + _SLIP_M, distance_m, median_m)[:, None]
    return ends, np.isfinite(distance_m)


def _pulled(points: np.ndarray, landmarks: np.ndarray, numbers: list[int]) -> np.ndarray:
    """Move points [V, 3] near the landmarks so that the grid's landmarks lie on the model's [K, 3].

    Rays miss landmarks that are hidden from them, such as the inner corners of the mouth behind the lips.
    """
    corners, weights = (tensor.numpy()[numbers] for tensor in landmark_weights())
    reached = (points[corners] * weights[..., None]).sum(1)
    kernel = np.exp(-((cdist(reached, reached) / _PULL_M) ** 2))
    strength = np.linalg.solve(kernel + 1e-3 * np.eye(len(reached)), landmarks - reached)
    return points + np.exp(-((cdist(points, reached) / _PULL_M) ** 2)) @ strength


def nearest_on_mesh(mesh: trimesh.Trimesh, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the points [N, 3] of a mesh nearest to `points` [N, 3], and their faces [N]."""
    _, nearby = cKDTree(mesh.triangles_center).query(points, _CANDIDATES)
    closest = np.stack(
        [trimesh.triangles.closest_point(mesh.triangles[faces], points) for faces in nearby.T]
    )  # [candidates, N, 3]
    best = np.linalg.norm(closest - points, axis=-1).argmin(0)
    rows = np.arange(len(points))
    return closest[best, rows], nearby[rows, best]


def rigid_alignment(points: np.ndarray, onto: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the rotation [3, 3] and translation [3] that align points [N, 3] with `onto` [N, 3] (Kabsch)."""
    centre, target = points.mean(0), onto.mean(0)
    u, _, vt = np.linalg.svd((points - centre).T @ (onto - target))
    flip = np.diag([1, 1, np.sign(np.linalg.det(vt.T @ u.T))])
    rotation = vt.T @ flip @ u.T
    return rotation, target - rotation @ centre
