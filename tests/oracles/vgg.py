"""VGG-16's convolutions, slowly: each output value from its neighbourhood."""

import numpy as np


def features(tensors: dict[str, np.ndarray], linear: np.ndarray) -> dict[str, np.ndarray]:
    """Return conv1_2, conv2_2 and conv3_3 after their ReLU, [C, H, W], of a linear image [3, H, W]."""
    encoded = np.array([[[_srgb(value) for value in row] for row in plane] for plane in linear])
    x = np.stack([(encoded[0] - 0.485) / 0.229, (encoded[1] - 0.456) / 0.224, (encoded[2] - 0.406) / 0.225])
    found = {}
    for name, place in {
        "conv1_1": 0,
        "conv1_2": 2,
        "pool1": None,
        "conv2_1": 5,
        "conv2_2": 7,
        "pool2": None,
        "conv3_1": 10,
        "conv3_2": 12,
        "conv3_3": 14,
    }.items():
        if place is None:
            x = halved(x)
        else:
            x = convolved(x, tensors[f"features.{place}.weight"], tensors[f"features.{place}.bias"])
            found[name] = x
    return {name: found[name] for name in ("conv1_2", "conv2_2", "conv3_3")}


def _srgb(linear: float) -> float:
    return 12.92 * linear if linear <= 0.0031308 else 1.055 * linear ** (1 / 2.4) - 0.055


def convolved(x: np.ndarray, weight: np.ndarray, bias: np.ndarray) -> np.ndarray:
    _, height, width = x.shape
    around = np.zeros((x.shape[0], height + 2, width + 2))
    around[:, 1:-1, 1:-1] = x
    result = np.empty((len(weight), height, width))
    for i in range(height):
        for j in range(width):
            for k in range(len(weight)):
                result[k, i, j] = max(0.0, (weight[k] * around[:, i : i + 3, j : j + 3]).sum() + bias[k])
    return result


def halved(x: np.ndarray) -> np.ndarray:
    channels, height, width = x.shape
    result = np.empty((channels, height // 2, width // 2))
    for i in range(height // 2):
        for j in range(width // 2):
            result[:, i, j] = x[:, 2 * i : 2 * i + 2, 2 * j : 2 * j + 2].max((1, 2))
    return result
