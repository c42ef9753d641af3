"""Boxes of faces in a photo, by dlib's detector: histograms of gradients and a linear classifier.

Dalal and Triggs, *Histograms of oriented gradients for human detection*, 2005.
"""

from functools import cache
from typing import Any

import dlib
import numpy as np
import torch

from facerf_cli.face.crop import Box
from facerf_cli.image.strips import block_means

DETECTOR_LICENCE = "dlib HOG frontal face detector: Boost Software License 1.0"
_ENLARGE = 2.0  # largest enlargement of a small image
_LEAST_SCORE = -0.15  # of a box; the Parsing Network drops those that are no face


def detected_boxes(image_srgb: np.ndarray, side_px: int) -> list[Box]:
    """Find boxes (left, top, right, bottom) of upright faces in an sRGB uint8 image [H, W, 3], in its pixels.

    The detector looks at a copy whose longest side is `side_px`; it finds faces of 80 pixels there, and more.
    """
    height, width = image_srgb.shape[:2]
    small = reduced(image_srgb, min(side_px / max(height, width), _ENLARGE))
    across, down = width / small.shape[1], height / small.shape[0]
    rectangles, _, _ = detector().run(np.ascontiguousarray(small), 0, _LEAST_SCORE)
    return [
        (across * box.left(), down * box.top(), across * (box.right() + 1), down * (box.bottom() + 1))
        for box in rectangles
    ]


def reduced(image: np.ndarray, scale: float) -> np.ndarray:
    """Resize to uint8 by averaging (or smoothly enlarging) without a float copy of the whole image."""
    block = max(1, min(int(1 / scale), *image.shape[:2]))  # an image may be one pixel wide
    size = [max(1, round(length * scale)) for length in image.shape[:2]]
    tensor = torch.from_numpy(block_means(image, block)).permute(2, 0, 1)[None]
    resized = torch.nn.functional.interpolate(tensor, size, mode="bilinear", antialias=True)[0]
    return resized.permute(1, 2, 0).round().clamp(0, 255).byte().numpy()


@cache
def detector() -> Any:
    """The detector, once a process."""
    return dlib.get_frontal_face_detector()
