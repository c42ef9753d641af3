"""Light wrap: a background's light that runs over the edge of who stands before it, as compositors add it."""

import numpy as np
from scipy.ndimage import gaussian_filter

from facerf_cli.image.strips import Resized, Rows, block_means, strips

_SPREAD = 0.012  # standard deviation of the blur, as a share of the longer side
_SMALL_PX = 256  # the longer side is blurred at this size or up to twice it
_MOST_BLOCK = 32  # strips are as many rows, or a multiple


class LightWrap:
    """The light [H, W, 3] that a background sends over a matte's edge, by rows; to be added to the image.

    It is what shows of the background, blurred, within the matte: strongest at its edge.

    Args:
        background: The image behind [H, W, 3], scene-linear.
        matte: Share [H, W] of who stands before it.
        share: Factor of the light.
    """

    def __init__(self, background: Rows, matte: np.ndarray, share: float) -> None:
        block = 1
        while max(matte.shape) >= 2 * block * _SMALL_PX and block < _MOST_BLOCK:
            block *= 2
        height, width = matte.shape
        shown = []
        for rows in strips((height, width)):
            behind = (1 - matte[rows][..., None]) * background[rows]
            whole = np.pad(behind, ((0, -len(behind) % block), (0, -width % block), (0, 0)), mode="edge")
            shown.append(block_means(whole, block))
        small = np.concatenate(shown)
        sigma = _SPREAD * max(matte.shape) / block
        soft = gaussian_filter(share * small, (sigma, sigma, 0), mode="nearest")
        self._soft = Resized(soft, (block * small.shape[0], block * small.shape[1]))
        self._matte = matte

    def __getitem__(self, rows: slice, /) -> np.ndarray:
        """Some rows [h, W, 3]."""
        matte = self._matte[rows][..., None]
        return np.asarray(matte * self._soft[rows][:, : matte.shape[1]])
