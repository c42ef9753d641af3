"""The square around head and shoulders that the Portrait Network sees."""

import numpy as np

from facerf_cli.face.crop import Crop

SIDE_PX = 192  # pixels of the square
SIDES = 3.0  # its side in extents of the landmarks: the larger side of their bounds


def portrait_square(landmarks_px: np.ndarray, size_px: int = SIDE_PX) -> Crop:
    """The square of a photo around landmarks [68, 2] in its pixels."""
    low, high = landmarks_px.min(0), landmarks_px.max(0)
    side_px = SIDES * float((high - low).max())
    x_px, y_px = (low + high) / 2
    return Crop(float(x_px) - side_px / 2, float(y_px) - side_px / 2, side_px, size_px)
