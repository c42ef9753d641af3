"""The path of a head that drifts while frames are taken one after the other, told from errors of shading.

How far a frame lies from what photometric stereo predicts is the head's path, which bends slowly in the
order of the lights; an error of the shading model, much the same under neighbouring lamps; and each frame's
own. All three are Gaussian processes (Rasmussen and Williams 2006, 2.2 and 5.4). How far the head goes is
the value under which the measurements are likeliest: on a still head that is nowhere.
"""

import math
from collections.abc import Iterable
from dataclasses import dataclass
from itertools import product

import numpy as np
from scipy.linalg import cho_factor, cho_solve

_TIMES = (8.0, 20.0, 50.0)  # frames over which a path bends
_REACHES_PX = (0.25, 0.5, 1.0, 2.0, 4.0)  # standard deviation of a path, down and right each
_STILL = (1.0, 0.0)  # no path
_MODELS_PX, _MODEL_WIDTH = (0.3, 0.6), 0.6  # and of the shading model's error
_OWN_PX = (0.15, 0.4, 1.0, 2.0)  # and of what each frame has beside
_SURE = 5.0  # natural log by which a path must be likelier than none; less sees paths in Extended Yale B
_MOST = 300  # frames by which sizes are chosen; it costs their cube


@dataclass(frozen=True)
class _Sizes:
    """What measurements are made of, in pixels, and over how many frames the path bends."""

    frames: float
    reach_px: float
    model_px: float
    own_px: float

    def bends(self, apart: np.ndarray) -> np.ndarray:
        """What the path has in common at frames that lie so many apart."""
        return self.reach_px**2 * np.exp(-(apart**2) / (2 * self.frames**2))

    def covariance(self, rows: np.ndarray, near: np.ndarray) -> np.ndarray:
        """Of the measurements of frames [N], whose lamps are `near` each other [N, N]."""
        bends = self.bends(rows[:, None] - rows)
        return bends + self.model_px**2 * near + self.own_px**2 * np.eye(len(rows))


def head_path(moved_px: np.ndarray, trusted: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """The path [L, 2] at all frames, by measurements [L, 2] of those that are `trusted` [L]."""
    rows = np.flatnonzero(trusted)
    if not len(rows):
        return np.zeros(moved_px.shape)
    few = rows[:: max(math.ceil(len(rows) / _MOST), 1)]
    near = _near(directions[few])

    def likeliest(paths: Iterable[tuple[float, float]]) -> tuple[float, _Sizes]:
        tries = [_Sizes(*path, *errors) for path in paths for errors in product(_MODELS_PX, _OWN_PX)]
        found = [_log_likelihood(sizes.covariance(few, near), moved_px[few]) for sizes in tries]
        return max(found), tries[int(np.argmax(found))]

    still, _ = likeliest([_STILL])
    best, sizes = likeliest(product(_TIMES, _REACHES_PX))
    if best <= still + _SURE:
        return np.zeros(moved_px.shape)
    covariance = sizes.covariance(rows, _near(directions[rows]))
    bends = sizes.bends(np.arange(len(trusted))[:, None] - rows)
    return bends @ cho_solve(cho_factor(covariance), moved_px[rows])


def _near(directions: np.ndarray) -> np.ndarray:
    """How much of the model's error lamps [N, 3] have in common [N, N]."""
    return np.exp((directions @ directions.T - 1) / _MODEL_WIDTH**2)


def _log_likelihood(covariance: np.ndarray, seen: np.ndarray) -> float:
    """Of two columns of measurements [N, 2], but for a constant."""
    factor = cho_factor(covariance)
    log_volume = 2 * np.log(np.diag(factor[0])).sum()
    return float(-0.5 * (seen * cho_solve(factor, seen)).sum() - log_volume)
