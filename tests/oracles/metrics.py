"""Metrics, slowly: each by its definition, one pixel at a time."""

import math

import numpy as np


def best_scale(prediction: np.ndarray, truth: np.ndarray, mask: np.ndarray) -> float:
    """Minimize the error over scales by ternary search."""
    low, high = 0.0, 100.0
    for _ in range(200):
        third = (high - low) / 3
        if _error(prediction, truth, mask, low + third) < _error(prediction, truth, mask, high - third):
            high -= third
        else:
            low += third
    return (low + high) / 2


def si_mse(prediction: np.ndarray, truth: np.ndarray, mask: np.ndarray) -> float:
    return _error(prediction, truth, mask, best_scale(prediction, truth, mask))


def _error(prediction: np.ndarray, truth: np.ndarray, mask: np.ndarray, scale: float) -> float:
    total = weight = 0.0
    for index in np.ndindex(truth.shape):
        share = float(mask[index[:2]])
        total += share * (scale * float(prediction[index]) - float(truth[index])) ** 2
        weight += share
    return total / weight


def mse(prediction: np.ndarray, truth: np.ndarray, mask: np.ndarray) -> float:
    return _error(np.clip(prediction, 0, 1), np.clip(truth, 0, 1), mask, 1.0)


def ssim(prediction: np.ndarray, truth: np.ndarray, mask: np.ndarray) -> float:
    """Wang et al. 2004 at each pixel; beyond the border the image is mirrored, with its edge repeated."""
    scale = best_scale(prediction, truth, mask)
    window = [math.exp(-0.5 * (step / 1.5) ** 2) for step in range(-5, 6)]
    total = weight = 0.0
    height, width = mask.shape
    for channel in range(truth.shape[2]):
        p = np.clip(scale * prediction[..., channel], 0, 1) * mask
        t = np.clip(truth[..., channel], 0, 1) * mask
        for y in range(height):
            for x in range(width):
                total += mask[y, x] * _similar(p, t, y, x, window)
                weight += mask[y, x]
    return float(total / weight)


def _similar(p: np.ndarray, t: np.ndarray, y: int, x: int, window: list[float]) -> float:
    height, width = p.shape
    sums = np.zeros(6)
    for i, down in enumerate(window):
        for j, right in enumerate(window):
            at = _mirrored(y + i - 5, height), _mirrored(x + j - 5, width)
            a, b = float(p[at]), float(t[at])
            sums += down * right * np.array([1, a, b, a * a, b * b, a * b])
    _, a, b, aa, bb, ab = sums / sums[0]
    c1, c2 = 0.01**2, 0.03**2
    alike = (2 * a * b + c1) * (2 * (ab - a * b) + c2)
    return alike / ((a * a + b * b + c1) * (aa - a * a + bb - b * b + c2))


def _mirrored(index: int, length: int) -> int:
    return -index - 1 if index < 0 else 2 * length - 1 - index if index >= length else index
