"""Each frame as the frames under the lamps around it have it, cast shadows and highlights included.

Every pixel is a Gaussian process over the lamp's direction (C. Rasmussen, C. Williams, *Gaussian Processes
for Machine Learning*, 2006), and what it predicts of a frame that it did not see is the same weighted sum of
the others at all pixels (there, equation 5.12).
"""

import numpy as np

_WIDTH = 0.6  # of the unit sphere: how far from a lamp another one still tells of it
_NOISE = 0.05
_MEAN = 1e-3  # variance of what all frames share
_ROUNDS = 4


def weights_of_others(directions: np.ndarray) -> np.ndarray:
    """What each frame is of the others [L, L], its diagonal 0, by the lamps' directions [L, 3]."""
    kernel = np.exp((directions @ directions.T - 1) / _WIDTH**2) + _MEAN
    inverse = np.linalg.inv(kernel + _NOISE * np.eye(len(directions)))
    return np.eye(len(directions)) - inverse / np.diag(inverse)[:, None]


def own_motion(weights: np.ndarray, moved_px: np.ndarray, trusted: np.ndarray, shrink: float) -> np.ndarray:
    """Motion [L, 2] of each frame that explains how far each lies from its prediction [L, 2].

    A prediction moves with the frames that it is made of. What all frames of a region share cannot be told
    from how shading moves with the lamp, and `shrink` leaves it out. Frames that disagree count less.
    """
    differences = np.eye(len(weights)) - weights
    ridge, count = shrink * np.eye(len(weights)), trusted.astype(float)
    for _ in range(_ROUNDS):
        weighed = differences.T * count
        found = np.linalg.solve(weighed @ differences + ridge, weighed @ moved_px)
        residual = np.hypot(*(moved_px - differences @ found).T)
        spread = 1.48 * np.median(residual[trusted]) + 0.02 if trusted.any() else 1.0
        count = trusted / (1 + (residual / (2 * spread)) ** 2)
    return found
