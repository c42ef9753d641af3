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
from scipy.spatial.distance import cdist

from facerf_cli.errors import InputError
from facerf_cli.face.importers.basel import read_basel_2009, read_basel_2017
from facerf_cli.face.importers.find_landmarks import landmarks_of, nearest_on_mesh, rigid_alignment
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
from facerf_cli.files.texts import read_bytes, text_of
from facerf_cli.run.logs import one_line

_MAX_LETTERS = 10_000  # of a list of vertex numbers
_HEAD_M, _EYES_M = (0.12, 1.0), (0.06, 0.13)  # a length outside these ranges is in another unit
_SLIP_M = 0.006  # a ray this far behind its neighbours slipped between the lips or lids
_PULL_M = 0.005  # radius around a landmark in which the grid is pulled onto it
_LEAST_COVERED = 0.75  # share of the grid that a model's surface must cover


def import_face_model(kind: str, path: Path, landmarks: Path | None = None) -> MorphableModel:
    """Import the model in `path`, of one of the kinds of `facerf face-model import`.

    `landmarks` is an embedding for FLAME, or for any kind a .txt of 68 vertex numbers from 0. Raises
    InputError for files that cannot be imported.
    """
    source = _read(kind, path, landmarks)
    try:
        return resample_model(source)
    except InputError as error:
        raise InputError(f"{path}: {error}") from None


def _read(kind: str, path: Path, landmarks: Path | None) -> SourceModel:
    listed = landmarks is not None and landmarks.suffix == ".txt"
    if kind == "flame":
        source = read_flame(path, None if listed else landmarks)
    elif landmarks is not None and not listed:
        raise InputError(f"{landmarks}: not for {kind}; give the landmarks as a .txt of 68 vertex numbers")
    elif kind == "basel-2009":
        source = read_basel_2009(path)
    elif kind in ("basel-2017", "basel-2019"):
        source = read_basel_2017(path, kind)
    else:
        source = read_ict_facekit(path)
    if landmarks is not None and listed:
        source.known.update(_listed(landmarks, source.mean))
    return source


def _listed(path: Path, mean: np.ndarray) -> dict[int, np.ndarray]:
    """The landmarks on a mean [N, 3] by number, from a text file of 68 vertex numbers."""
    advice = "give a .txt of 68 vertex numbers"
    try:
        numbers = [int(word) for word in text_of(read_bytes(path, _MAX_LETTERS, advice)).split()]
    except ValueError as error:
        raise InputError(f"{path}: cannot be read ({one_line(str(error))}); {advice}") from None
    if len(numbers) != 68 or not 0 <= min(numbers) <= max(numbers) < len(mean):
        raise InputError(f"{path}: holds {len(numbers)} numbers; give 68 from 0 to {len(mean) - 1}")
    return dict(enumerate(mean[numbers]))


def resample_model(source: SourceModel) -> MorphableModel:
    """Resample a model to the canonical topology.

    A model without expressions gets those of the built-in model, which has the same vertices. A surface that
    ends inside the grid, such as Basel's face12, continues as the built-in face and moves like its border.
    Raises InputError for a mean in another unit or without a face.
    """
    side_m = float(np.ptp(source.mean[np.unique(source.triangles)], 0).max())
    _require_size("its mean's largest side", side_m, _HEAD_M)
    landmarks = landmarks_of(source)
    eyes_m = float(np.linalg.norm(landmarks[OUTER_EYE_CORNERS[0]] - landmarks[OUTER_EYE_CORNERS[1]]))
    _require_size("the distance of its eyes' outer corners", eyes_m, _EYES_M)
    rotation, translation = rigid_alignment(landmarks, LANDMARKS_M)
    mean = source.mean @ rotation.T + translation
    corners, weights, covered = register(mean, source.triangles, landmarks @ rotation.T + translation)
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
    mean: np.ndarray, triangles: np.ndarray, landmarks: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Place the canonical vertices on a mesh: vertex ids and barycentric weights [V, 3], and a mask [V].

    A thin-plate spline of the landmarks' [68, 3] displacements from their canonical (u, v) warps the grid.
    The mask is true where the mesh covers a vertex.
    """
    warp = RBFInterpolator(LANDMARK_UV, cylinder_uv(landmarks) - LANDMARK_UV, kernel="thin_plate_spline")
    uv = grid_uv().double().numpy()
    mesh = trimesh.Trimesh(mean, triangles, process=False)
    points, covered = _cast(mesh, *cylinder_rays(uv + warp(uv)))
    points, faces = nearest_on_mesh(mesh, _pulled(points, landmarks))
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


def _pulled(points: np.ndarray, landmarks: np.ndarray) -> np.ndarray:
    """Move points [V, 3] near the landmarks so that the grid's landmarks lie on the model's [68, 3].

    Rays miss landmarks that are hidden from them, such as the inner corners of the mouth behind the lips.
    """
    corners, weights = (tensor.numpy() for tensor in landmark_weights())
    reached = (points[corners] * weights[..., None]).sum(1)
    kernel = np.exp(-((cdist(reached, reached) / _PULL_M) ** 2))
    strength = np.linalg.solve(kernel + 1e-3 * np.eye(len(reached)), landmarks - reached)
    return points + np.exp(-((cdist(points, reached) / _PULL_M) ** 2)) @ strength
