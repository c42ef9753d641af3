"""The path of a head that drifts while frames are taken one after the other, told from errors of shading.

How far a frame lies from what photometric stereo predicts is the head's path, which bends slowly in the
order of the lights; an error of the shading model, much the same under neighbouring lamps; and each frame's
own. All three are Gaussian processes (Rasmussen and Williams 2006, 2.2 and 5.4). How far the head goes is
the value under which the measurements are likeliest: on a still head that is nowhere.
"""

from itertools import product

import numpy as np

_TIMES = (8.0, 20.0, 50.0)  # frames over which a path bends
_REACHES_PX = (0.0, 0.25, 0.5, 1.0, 2.0, 4.0)  # standard deviation of a path, down and right each
_MODELS_PX, _MODEL_WIDTH = (0.3, 0.6), 0.6  # and of the shading model's error
_OWN_PX = (0.15, 0.4, 1.0, 2.0)  # and of what each frame has beside
_SURE = 5.0  # natural log by which a path must be likelier than none; less sees paths in Extended Yale B


def head_path(moved_px: np.ndarray, trusted: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """The path [L, 2] at all frames, by measurements [L, 2] of those that are `trusted` [L]."""
    rows = np.flatnonzero(trusted)
    seen = moved_px[rows]
    near = np.exp((directions[rows] @ directions[rows].T - 1) / _MODEL_WIDTH**2)
    apart = (np.arange(len(trusted))[:, None] - rows) ** 2
    path, best, none = np.zeros(moved_px.shape), -np.inf, -np.inf
    for frames, reach_px, model_px, own_px in product(_TIMES, _REACHES_PX, _MODELS_PX, _OWN_PX):
        bends = reach_px**2 * np.exp(-apart / (2 * frames**2))  # [L, rows]
        covariance = bends[rows] + model_px**2 * near + own_px**2 * np.eye(len(rows))
        likelihood = _log_likelihood(covariance, seen)
        if not reach_px:
            none = max(none, likelihood)
        if likelihood > best:
            best, path = likelihood, bends @ np.linalg.solve(covariance, seen)
    return path if best > none + _SURE else np.zeros(moved_px.shape)


def _log_likelihood(covariance: np.ndarray, seen: np.ndarray) -> float:
    """Of two columns of measurements [N, 2], but for a constant."""
    _, log_volume = np.linalg.slogdet(covariance)
    return float(-0.5 * (seen * np.linalg.solve(covariance, seen)).sum() - log_volume)
