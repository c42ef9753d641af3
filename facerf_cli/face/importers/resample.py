"""Import of a published face model: from its publisher's topology to the canonical grid.

The model's landmarks warp the grid in UV space, and rays through the warped grid find its surface.
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

_HEAD_M, _EYES_M = (0.12, 1.0), (0.06, 0.13)  # a length outside these ranges is in another unit
_SLIP_M = 0.006  # a ray this far behind its neighbours slipped between the lips or lids
_CANDIDATES = 12  # the nearest point is searched in this many triangles, those with the nearest centres
_PULL_M = 0.005  # radius around a landmark in which the grid is pulled onto it
_FEWEST_LANDMARKS = 12  # that place the grid
_LEAST_COVERED = 0.75  # share of the grid that a model's surface must cover


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
        raise InputError(f"{landmarks}: --landmarks is for FLAME, and {path} is not; remove it")
    return read_basel(path) if suffix in (".mat", ".h5") else read_ict_facekit(path)


def resample_model(source: SourceModel) -> MorphableModel:
    """Resample a model to the canonical topology.

    A model without expressions gets those of the built-in model, which has the same vertices. A surface that
    ends inside the grid, such as Basel's face12, continues as the built-in face and moves like its border.
    Raises InputError for a mean in another unit, and for a model that names too few landmarks.
    """
    side_m = float(np.ptp(source.mean[np.unique(source.triangles)], 0).max())
    _require_size("its mean's largest side", side_m, _HEAD_M)
    known = source.known
    if len(known) < _FEWEST_LANDMARKS or not known.keys() >= set(OUTER_EYE_CORNERS):
        raise InputError(
            f"it names {len(known)} of the landmarks, too few; give the file as it was published"
        )
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
    """Raise InputError for a length outside a range."""
    if not between_m[0] < length_m < between_m[1]:
        raise InputError(f"{what} is {1000 * length_m:.4g} mm; give the model in the unit of its publication")


def _beyond(covered: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The border [V] of the covered vertices [V], and weights [M, B] from its vertices to the uncovered ones.

    Inverse distance weights: exact at the border, smooth beyond.
    """
    border = covered & binary_dilation(~covered.reshape(GRID, GRID)).ravel()
    grid = grid_uv().double().numpy()
    pull = 1 / (cdist(grid[~covered], grid[border]) ** 4 + 1e-12)
    return border, pull / pull.sum(-1, keepdims=True)


def register(
    mean: np.ndarray, triangles: np.ndarray, landmarks: np.ndarray, numbers: list[int]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Place the canonical vertices on a mesh: vertex ids and barycentric weights [V, 3], and a mask [V].

    A thin-plate spline of the displacements of the landmarks [K, 3] of these numbers [K] from their canonical
    (u, v) warps the grid. The mask is true where the mesh covers a vertex.
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
    """Points [V, 3] where the grid's rays meet the mesh, and a mask [V] of the rays that do.

    A ray that slips into a slit ends at the distance of its neighbours.
    """
    points, rays, _ = mesh.ray.intersects_location(origins, directions, multiple_hits=False)
    if len(rays) < len(origins) * _LEAST_COVERED:
        raise InputError(
            f"its surface covers {100 * len(rays) / len(origins):.0f} % of the face, from the forehead to "
            f"below the chin; {100 * _LEAST_COVERED:.0f} % are needed, so give the model's larger mesh"
        )
    travelled = np.full(len(origins), np.inf)
    travelled[rays] = np.linalg.norm(points - origins[rays], axis=-1)
    filled = np.where(np.isfinite(travelled), travelled, travelled[rays].max())
    usual = median_filter(filled.reshape(GRID, GRID), 5).ravel()
    ends = origins + directions * np.where(travelled < usual + _SLIP_M, travelled, usual)[:, None]
    return ends, np.isfinite(travelled)


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
    """The points [N, 3] of a mesh nearest to `points` [N, 3], and their faces [N]."""
    _, nearby = cKDTree(mesh.triangles_center).query(points, _CANDIDATES)
    closest = np.stack(
        [trimesh.triangles.closest_point(mesh.triangles[faces], points) for faces in nearby.T]
    )  # [candidates, N, 3]
    best = np.linalg.norm(closest - points, axis=-1).argmin(0)
    rows = np.arange(len(points))
    return closest[best, rows], nearby[rows, best]


def rigid_alignment(points: np.ndarray, onto: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rotation [3, 3] and translation [3] that bring points [N, 3] nearest to `onto` [N, 3] (Kabsch)."""
    centre, target = points.mean(0), onto.mean(0)
    u, _, vt = np.linalg.svd((points - centre).T @ (onto - target))
    flip = np.diag([1, 1, np.sign(np.linalg.det(vt.T @ u.T))])
    rotation = vt.T @ flip @ u.T
    return rotation, target - rotation @ centre
