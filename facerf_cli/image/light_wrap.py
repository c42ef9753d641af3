"""Light wrap: light of a background that spills over the edge of the person in front of it."""

import numpy as np
from scipy.ndimage import gaussian_filter

from facerf_cli.image.strips import Resized, Rows, block_means, strips

_SPREAD = 0.012  # standard deviation of the blur, in lengths of the longer side
_SMALL_PX = 256  # the blur is computed at this longer side, or up to twice it
_MOST_BLOCK = 32  # strips have this number of rows, or a multiple


class LightWrap:
    """Light [H, W, 3] of a background over a matte's edge, by rows, to be added to the image.

    The visible background is blurred and multiplied by the matte, so it is strongest at the edge.

    Args:
        background: Background image [H, W, 3], scene-linear.
        matte: Alpha of the person [H, W].
        share: Strength of the light.
    """

    def __init__(self, background: Rows, matte: np.ndarray, share: float) -> None:
        block = 1
        while max(matte.shape) >= 2 * block * _SMALL_PX and block < _MOST_BLOCK:
            block *= 2
        height, width = matte.shape
        visible = []
        for rows in strips((height, width)):
            behind = (1 - matte[rows][..., None]) * background[rows]
            padded = np.pad(behind, ((0, -len(behind) % block), (0, -width % block), (0, 0)), mode="edge")
            visible.append(block_means(padded, block))
        small = np.concatenate(visible)
        sigma = _SPREAD * max(matte.shape) / block
        soft = gaussian_filter(share * small, (sigma, sigma, 0), mode="nearest")
        self._soft = Resized(soft, (block * small.shape[0], block * small.shape[1]))
        self._matte = matte

    def __getitem__(self, rows: slice, /) -> np.ndarray:
        matte = self._matte[rows][..., None]
        return np.asarray(matte * self._soft[rows][:, : matte.shape[1]])
