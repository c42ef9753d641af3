"""Brute-force visibility: every ray against every triangle (Möller and Trumbore, 1997)."""

import numpy as np


def occluded(origins: np.ndarray, direction: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """Return whether a triangle [F, 3, 3] lies along `direction` [3] from each origin [N, 3]; bool [N]."""
    edge_1, edge_2 = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    p = np.cross(direction, edge_2)
    determinant = (edge_1 * p).sum(-1)
    usable = np.abs(determinant) > 1e-14
    inverse = 1 / np.where(usable, determinant, 1)
    result = np.zeros(len(origins), bool)
    for index, origin in enumerate(origins):
        offset = origin - corners[:, 0]
        u = (offset * p).sum(-1) * inverse
        q = np.cross(offset, edge_1)
        v = (q @ direction) * inverse
        distance = (edge_2 * q).sum(-1) * inverse
        result[index] = (usable & (u >= 0) & (v >= 0) & (u + v <= 1) & (distance > 0)).any()
    return result
