"""Between samples: the extremum of a curve that is known at some places."""

import numpy as np


def vertex(x: np.ndarray, y: np.ndarray, place: int) -> float:
    """Where the parabola through the least or highest of values y [N] at x [N] and its neighbours turns.

    That is between the neighbours; x[place] at an end, or where the three values are one.
    """
    if not 0 < place < len(x) - 1:
        return float(x[place])
    slopes = np.diff(y[place - 1 : place + 2]) / np.diff(x[place - 1 : place + 2])
    bend = (slopes[1] - slopes[0]) / (x[place + 1] - x[place - 1])
    return float((x[place - 1] + x[place]) / 2 - slopes[0] / (2 * bend)) if bend else float(x[place])
