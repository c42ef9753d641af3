"""Regions of an image: how deep a pixel lies in one, and which parts of one hold a seed."""

import numpy as np
from scipy.ndimage import distance_transform_edt, label


def depth_px(region: np.ndarray) -> np.ndarray:
    """Distance [h, w] of pixels of a region [h, w] from its border; beyond the image the region goes on."""
    return np.asarray(distance_transform_edt(np.pad(region, 1, "edge"))[1:-1, 1:-1])


def joined_to(region: np.ndarray, seeds: np.ndarray) -> np.ndarray:
    """Pixels [h, w] of those parts of a region [h, w] that hold a seed [h, w]."""
    parts, _ = label(region)
    return region & np.isin(parts, parts[seeds])
