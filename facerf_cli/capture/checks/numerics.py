"""Small numeric functions that several checks share."""

import numpy as np


def angle_deg(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Angles between unit vectors [..., 3], in degrees."""
    return np.degrees(np.arccos(np.clip((a * b).sum(-1), -1, 1)))


def parabola_vertex(x: np.ndarray, y: np.ndarray, place: int) -> float:
    """Refine the place of an extremum of samples y [N] at x [N] by a parabola through it and its neighbours.

    Returns x[place] for a sample at an end, or where the three values are equal.
    """
    if not 0 < place < len(x) - 1:
        return float(x[place])
    slopes = np.diff(y[place - 1 : place + 2]) / np.diff(x[place - 1 : place + 2])
    bend = (slopes[1] - slopes[0]) / (x[place + 1] - x[place - 1])
    return float((x[place - 1] + x[place]) / 2 - slopes[0] / (2 * bend)) if bend else float(x[place])
