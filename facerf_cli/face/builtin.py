"""The built-in morphable model: mean, identities and expressions made from tables of measures, not scans.

`python -m facerf_cli.face.builtin` writes it to `assets/builtin_face.npz`. The identity basis is a Gaussian
process on the mean face (Lüthi et al., 'Gaussian Process Morphable Models'): smooth deformations at three
length scales, mostly mirror symmetric, without rigid motion and with little change of size, reduced to their
largest modes.
"""

import numpy as np
import torch
from scipy.linalg import eigh

from facerf_cli.face.anatomy import mean_vertices
from facerf_cli.face.expressions import EXPRESSION_STD, expression_shapes
from facerf_cli.face.morphable import BUILTIN, BUILTIN_PATH, MorphableModel, save_face_model
from facerf_cli.face.topology import GRID

IDENTITIES = 80
_SCALES_MM = ((80.0, 2.8), (35.0, 1.75))  # length scale, standard deviation along each axis
_DETAIL_SCALE_MM, _DETAIL_STD_MM = 14.0, (0.4, 1.1)  # the latter at the chart's rim, and about the nose
_DETAIL_CENTRE_MM, _DETAIL_REACH_MM = np.array([0, 2, 115.0]), 50.0
_ASYMMETRIC_SHARE = 0.02  # of the variance
_SIZE_STD = 0.035
_NODE_STEP = 4  # the process is solved on every fourth vertex each way (Nyström)
_MIRROR = np.array([-1.0, 1, 1])


def build() -> MorphableModel:
    """The whole model, the same on every call."""
    mean_m = mean_vertices()
    shapes = expression_shapes(mean_m)
    identity_m = identity_basis(mean_m * 1000) / 1000
    expression_m = EXPRESSION_STD * np.stack(list(shapes.values()))
    mean, identity, expression = (
        torch.from_numpy(array.astype(np.float32)) for array in (mean_m, identity_m, expression_m)
    )
    return MorphableModel(BUILTIN, "facerf's own (see LICENSE)", mean, identity, expression, tuple(shapes))


def identity_basis(mean_mm: np.ndarray) -> np.ndarray:
    """The largest modes [K, V, 3] in millimetres, each scaled by its standard deviation, largest first."""
    nodes = np.arange(GRID * GRID).reshape(GRID, GRID)[::_NODE_STEP, ::_NODE_STEP].reshape(-1)
    motions = _similarity_motions(mean_mm)
    fit_motions = np.linalg.pinv(motions[nodes].reshape(-1, 7))  # least squares over the nodes
    still = np.eye(len(nodes) * 3) - motions[nodes].reshape(-1, 7) @ fit_motions
    size = _SIZE_STD * motions[..., 6]
    size_nodes = size[nodes].reshape(-1)
    covariance = still @ _covariance(mean_mm[nodes], mean_mm[nodes]) @ still
    covariance = covariance + np.outer(size_nodes, size_nodes)
    count = len(covariance)
    variance, modes = eigh(covariance, subset_by_index=(count - IDENTITIES, count - 1))
    variance, modes = variance[::-1], modes[:, ::-1]
    modes = modes * np.sign(modes[np.abs(modes).argmax(0), range(IDENTITIES)])  # the same on every machine
    parts = np.array_split(mean_mm, 16)
    smooth = np.concatenate([_covariance(part, mean_mm[nodes]) @ (still @ modes) for part in parts])
    smooth = smooth.reshape(-1, 3, IDENTITIES)
    smooth = smooth - motions @ (fit_motions @ smooth[nodes].reshape(-1, IDENTITIES))
    grown = size[..., None] * (size_nodes @ modes)
    return np.moveaxis((smooth + grown) / np.sqrt(variance), -1, 0)  # Nystroem's extension from the nodes


def _covariance(a_mm: np.ndarray, b_mm: np.ndarray) -> np.ndarray:
    """Matrix-valued kernel [A * 3, B * 3] in square millimetres between points a [A, 3] and b [B, 3].

    The symmetric part is the covariance of (f(x) + M f(M x)) / sqrt 2 with M the mirror.
    """
    direct, across = _kernel(a_mm, b_mm), _kernel(a_mm, b_mm * _MIRROR)
    own = direct[:, None, :, None] * np.eye(3)[:, None]
    mirrored = across[:, None, :, None] * np.diag(_MIRROR)[:, None]
    return (own + (1 - 2 * _ASYMMETRIC_SHARE) * mirrored).reshape(len(a_mm) * 3, len(b_mm) * 3)


def _kernel(a_mm: np.ndarray, b_mm: np.ndarray) -> np.ndarray:
    squared = _squared_distance(a_mm, b_mm)
    broad = sum(std**2 * np.exp(-squared / (2 * scale**2)) for scale, std in _SCALES_MM)
    return broad + _detail(a_mm)[:, None] * _detail(b_mm) * np.exp(-squared / (2 * _DETAIL_SCALE_MM**2))


def _detail(points_mm: np.ndarray) -> np.ndarray:
    """Standard deviation [N] of fine deformation: features differ more than foreheads."""
    rim, features = _DETAIL_STD_MM
    nearness = np.exp(-((points_mm - _DETAIL_CENTRE_MM) ** 2).sum(-1) / (2 * _DETAIL_REACH_MM**2))
    return rim + (features - rim) * nearness


def _squared_distance(a_mm: np.ndarray, b_mm: np.ndarray) -> np.ndarray:
    return (a_mm**2).sum(-1)[:, None] + (b_mm**2).sum(-1) - 2 * a_mm @ b_mm.T


def _similarity_motions(mean_mm: np.ndarray) -> np.ndarray:
    """Moving, turning and growing the mean about its centre, as displacements [V, 3, 7]."""
    centred = mean_mm - mean_mm.mean(0)
    shifts = np.broadcast_to(np.eye(3), (len(mean_mm), 3, 3))
    turns = np.cross(np.eye(3)[None], centred[:, None]).transpose(0, 2, 1)
    return np.concatenate([shifts, turns, centred[..., None]], -1)


if __name__ == "__main__":
    BUILTIN_PATH.parent.mkdir(exist_ok=True)
    save_face_model(BUILTIN_PATH, build())
