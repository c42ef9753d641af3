"""A picture moved by parts of pixels: how a head that moved between frames is taken back."""

import numpy as np


def moved(picture: np.ndarray, down_px: float, right_px: float) -> np.ndarray:
    """The picture [H, W, C] moved down and right, between pixels linearly, its border repeated."""
    return _along(_along(picture, 0, down_px), 1, right_px)


def _along(picture: np.ndarray, axis: int, by_px: float) -> np.ndarray:
    if by_px == 0:
        return picture
    length = picture.shape[axis]
    at = np.clip(np.arange(length) - by_px, 0, length - 1)
    before = np.floor(at).astype(int)
    after = np.minimum(before + 1, length - 1)
    share = (at - before).astype(picture.dtype)
    share = share.reshape([-1 if other == axis else 1 for other in range(picture.ndim)])
    return (1 - share) * picture.take(before, axis) + share * picture.take(after, axis)
