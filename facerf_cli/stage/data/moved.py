"""A picture moved by parts of pixels: how a head that moved between frames is taken back."""

import numpy as np


def moved(picture: np.ndarray, down_px: float, right_px: float) -> np.ndarray:
    """The picture [H, W, C] moved down and right, its border repeated; whole shifts are exact.

    Between pixels by cubic convolution (R. Keys, *Cubic convolution interpolation for digital image
    processing*, ASSP 1981), which keeps detail that straight lines between pixels lose.
    """
    return _along(_along(picture, 0, down_px), 1, right_px)


def _along(picture: np.ndarray, axis: int, by_px: float) -> np.ndarray:
    if by_px == 0:
        return picture
    first = int(np.floor(-by_px))
    places = np.arange(picture.shape[axis]) + first
    summed = np.zeros_like(picture)
    for tap, weight in enumerate(_keys(-by_px - first), start=-1):
        if weight:
            at = np.clip(places + tap, 0, picture.shape[axis] - 1)
            summed += picture.dtype.type(weight) * picture.take(at, axis)
    return summed


def _keys(t: float) -> tuple[float, float, float, float]:
    """Weights of the pixels at -1, 0, 1 and 2 for a place t past 0, in 0..1 (there, equation 15)."""
    return (
        -t * (1 - t) ** 2 / 2,
        1 - (5 - 3 * t) * t**2 / 2,
        t * (1 + 4 * t - 3 * t**2) / 2,
        -(t**2) * (1 - t) / 2,
    )
