"""Smoothing over time by the frames on both sides: curves, and maps.

A curve is smoothed by a local quadratic (Savitzky and Golay, *Smoothing and differentiation of data by
simplified least squares procedures*, 1964), with weights, so that frames that are missing or unsure count for
nothing or little. It has no delay, and keeps a movement that is a parabola over the window. Maps are smoothed
by a bilateral filter along time (Tomasi and Manduchi, *Bilateral filtering for gray and color images*, 1998):
a pixel takes part in the mean as far as the image there looks as it does in the frame itself.
"""

from collections.abc import Sequence

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

REACH = 5  # frames on each side of a curve's window
_FULL = 4  # frames with weight from which on a window has a quadratic; with fewer it is a line or a mean
MAPS_REACH = 2  # frames on each side of a map's window
_ALIKE = 0.03  # difference of images, in 0..1, at which a neighbour's weight falls to 0.6
_BLUR_PX = 3  # side of the square over which images are compared, against their noise
_TINY = 1e-9


def smoothed(values: np.ndarray, weights: np.ndarray, reach: int = REACH) -> np.ndarray:
    """Smooth curves [N, ...] with weights [N] >= 0 by local quadratics; NaN where a window has no weight.

    The window has `reach` frames on each side, under a tricube (Cleveland, *Robust locally weighted
    regression and smoothing scatterplots*, 1979).
    """
    flat = values.reshape(len(values), -1).astype(np.float64)
    result = np.full_like(flat, np.nan)
    for frame in range(len(flat)):
        first, last = max(0, frame - reach), min(len(flat), frame + reach + 1)
        at = np.arange(first, last) - frame
        weight = weights[first:last] * (1 - (np.abs(at) / (reach + 1)) ** 3) ** 3
        used = weight > 0
        if used.any():
            result[frame] = _local(at[used], flat[first:last][used], weight[used])
    return result.reshape(values.shape)


def _local(at: np.ndarray, values: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """The value [C] at 0 of the polynomial that fits values [M, C] at times [M] best."""
    order = 2 if len(at) >= _FULL else min(1, len(at) - 1)
    columns = np.vander(at, order + 1, increasing=True) * np.sqrt(weight)[:, None]
    return np.asarray(np.linalg.lstsq(columns, values * np.sqrt(weight)[:, None], rcond=None)[0][0])


def steadied(maps: Sequence[Tensor], images: Sequence[Tensor], middle: int) -> Tensor:
    """Mean over time of maps [C, h, w] of neighbouring frames, for the frame `middle` of them.

    images [3, h, w] in 0..1, display-encoded, say where the frames look alike.
    """
    own = _blurred(images[middle])
    total, weight = torch.zeros_like(maps[middle]), torch.zeros_like(own[:1])
    for index, (one, image) in enumerate(zip(maps, images, strict=True)):
        apart = (_blurred(image) - own).square().mean(0, keepdim=True)
        near = 1 - abs(index - middle) / (MAPS_REACH + 1)
        share = near * torch.exp(-apart / (2 * _ALIKE**2))
        total, weight = total + share * one, weight + share
    return total / weight.clamp_min(_TINY)


def _blurred(image: Tensor) -> Tensor:
    return F.avg_pool2d(image[None], _BLUR_PX, stride=1, padding=_BLUR_PX // 2, count_include_pad=False)[0]
