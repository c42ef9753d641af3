"""A model in its own topology becomes one in the canonical (DESIGN, 'One topology inside')."""

import numpy as np
import torch
from scipy.ndimage import binary_dilation
from scipy.sparse import csr_matrix
from scipy.spatial.distance import cdist

from facerf_cli.errors import InputError
from facerf_cli.face.importers.carried_head import carried_head
from facerf_cli.face.importers.find_landmarks import find_landmarks
from facerf_cli.face.importers.registration import register, rigid_alignment
from facerf_cli.face.importers.source import SourceModel
from facerf_cli.face.morphable import MorphableModel, load_face_model
from facerf_cli.face.topology import GRID, LANDMARKS_M, OUTER_EYE_CORNERS, grid_uv

_HEAD_M, _EYES_M = (0.12, 1.0), (0.06, 0.13)  # beyond these, a length is in another unit


def carry_over(source: SourceModel) -> MorphableModel:
    """Carry a model to the canonical topology: its landmarks warp the chart, rays find its surface.

    A model without expressions is given the built-in model's, whose vertices are the same; one whose surface
    ends inside the chart, as Basel's face12 does, goes on as the built-in face, and moves as its own border.
    """
    side_m = float(np.ptp(source.mean[np.unique(source.triangles)], 0).max())
    _require_size("its mean's largest side is", side_m, _HEAD_M)
    landmarks = landmarks_of(source)
    eyes_m = float(np.linalg.norm(landmarks[OUTER_EYE_CORNERS[0]] - landmarks[OUTER_EYE_CORNERS[1]]))
    _require_size("its eyes' outer corners lie apart", eyes_m, _EYES_M)
    rotation, translation = rigid_alignment(landmarks, LANDMARKS_M)
    mean = source.mean @ rotation.T + translation
    corners, weights, covered = register(mean, source.triangles, landmarks @ rotation.T + translation)
    rows = np.arange(0, corners.size + 1, 3)
    onto_grid = csr_matrix((weights.ravel(), corners.ravel(), rows), (len(corners), len(mean)))
    builtin, (border, weights_beyond) = load_face_model(), _beyond(covered)

    def carried(field: np.ndarray, otherwise: np.ndarray | float = 0.0) -> torch.Tensor:
        off = onto_grid @ field - otherwise
        off[~covered] = weights_beyond @ off[border]
        return torch.from_numpy((off + otherwise).astype(np.float32))

    def carried_basis(basis: np.ndarray) -> torch.Tensor:
        return torch.stack([carried(shape @ rotation.T) for shape in basis])

    has_expressions = len(source.expression) > 0
    on_grid = carried(mean, builtin.mean.double().numpy())
    return MorphableModel(
        name=source.name,
        licence=source.licence + ("" if has_expressions else f"; expressions: {builtin.licence}"),
        mean=on_grid,
        identity=carried_basis(source.identity),
        expression=carried_basis(source.expression) if has_expressions else builtin.expression,
        expression_names=source.expression_names if has_expressions else builtin.expression_names,
        head=None
        if source.head is None
        else carried_head(source, source.head, on_grid.numpy(), rotation, translation),
    )


def landmarks_of(source: SourceModel) -> np.ndarray:
    """The 68 points [68, 3] on the source's mean: those that are known, the rest by the shape of the face."""
    if len(source.known) == 68:
        return np.stack([source.known[number] for number in range(68)])
    return find_landmarks(source.mean, source.triangles, source.known)


def _beyond(covered: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Which of the covered vertices [V] are the border [V], and the weights [M, B] of those for the others.

    Inverse distance, as in `carried_head.skin_uv`: what leaves the border is exact there, and smooth beyond.
    """
    border = covered & binary_dilation(~covered.reshape(GRID, GRID)).ravel()
    grid = grid_uv().double().numpy()
    pull = 1 / (cdist(grid[~covered], grid[border]) ** 4 + 1e-12)
    return border, pull / pull.sum(-1, keepdims=True)


def _require_size(what: str, length_m: float, between_m: tuple[float, float]) -> None:
    if not between_m[0] < length_m < between_m[1]:
        raise InputError(f"{what} {1000 * length_m:.4g} mm; is it in the unit of its publication?")
