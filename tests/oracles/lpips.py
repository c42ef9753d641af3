"""LPIPS on VGG-16, slowly, with the published code's scaling of images to -1..1."""

import numpy as np

from tests.oracles.vgg import convolved, halved

_SHIFT, _SCALE = (-0.030, -0.088, -0.188), (0.458, 0.448, 0.450)
_BLOCKS = ((0, 2), (5, 7), (10, 12, 14), (17, 19, 21), (24, 26, 28))  # convolutions between poolings


def lpips(
    tensors: dict[str, np.ndarray], heads: list[np.ndarray], first: np.ndarray, second: np.ndarray
) -> float:
    """Return the distance of two display-encoded images [3, H, W] in 0..1."""
    distance = 0.0
    for a, b, head in zip(_features(tensors, first), _features(tensors, second), heads, strict=True):
        _, height, width = a.shape
        for y in range(height):
            for x in range(width):
                u, v = (f[:, y, x] / (np.sqrt((f[:, y, x] ** 2).sum()) + 1e-10) for f in (a, b))
                distance += float((head * (u - v) ** 2).sum()) / (height * width)
    return distance


def _features(tensors: dict[str, np.ndarray], encoded: np.ndarray) -> list[np.ndarray]:
    """Return relu1_2, relu2_2, relu3_3, relu4_3 and relu5_3."""
    x = np.stack([(2 * plane - 1 - s) / d for plane, s, d in zip(encoded, _SHIFT, _SCALE, strict=True)])
    found = []
    for number, block in enumerate(_BLOCKS):
        x = halved(x) if number else x
        for place in block:
            x = convolved(x, tensors[f"features.{place}.weight"], tensors[f"features.{place}.bias"])
        found.append(x)
    return found
