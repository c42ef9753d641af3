"""Small arithmetic that all makers of a head's mesh share."""

import numpy as np


def unit(vectors: np.ndarray) -> np.ndarray:
    """Vectors [..., 3] scaled to length 1; a zero vector stays one."""
    return np.asarray(vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-12))


def smoothstep(value: np.ndarray, start: float = 0.0, end: float = 1.0) -> np.ndarray:
    """0 at `start` and before, 1 at `end` and beyond, smoothly in between."""
    share = np.clip((value - start) / (end - start), 0, 1)
    return np.asarray(share * share * (3 - 2 * share))


def arc_lengths(points: np.ndarray) -> np.ndarray:
    """How far along a line of points [N, C] each of them lies [N], from 0."""
    return np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=-1))])
