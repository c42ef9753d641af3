"""The light of a photo by least squares over a field's single lights (paper, 'Light Estimation')."""

import numpy as np
import torch
from scipy.linalg import qr
from scipy.optimize import nnls
from torch import Tensor

_RIDGE = 0.02  # against lights that undo each other, as a share of the picture's norm
_OUTLIER = 3.0  # a texel further off than this many median errors weighs in inverse proportion
_ROUNDS = 3  # of reweighting


def estimate_light(olats: Tensor, picture: Tensor) -> Tensor:
    """Non-negative weights [L, C] with which lights' pictures [L, C, N] sum to a picture [C, N].

    Eq. (leastsq) of the paper, a channel at a time, with what is clipped, covered or misfitted weighing less
    (iteratively reweighted least squares). Everything is scene-linear.
    """
    channels = [_weights(a, b) for a, b in zip(olats.unbind(1), picture, strict=True)]
    return torch.from_numpy(np.stack(channels, -1)).float()


def _weights(olats: Tensor, picture: Tensor) -> np.ndarray:
    lights, target = olats.double().T.numpy(), picture.double().numpy()  # [N, L], [N]
    if not len(target):  # nothing is seen well enough
        return np.zeros(lights.shape[1])
    ridge = _RIDGE * np.linalg.norm(target) * np.eye(lights.shape[1])
    trust = np.ones(len(target))
    for _ in range(_ROUNDS):
        rows = np.concatenate([lights * trust[:, None], ridge])
        basis, square = qr(rows, mode="economic")  # as small a problem as there are lights
        weights, _ = nnls(square, basis[: len(target)].T @ (target * trust))
        error = np.abs(lights @ weights - target)
        limit = _OUTLIER * np.median(error) + 1e-12
        trust = np.sqrt(np.minimum(1, limit / np.maximum(error, limit)))
    return np.asarray(weights)
