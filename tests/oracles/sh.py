"""Real spherical harmonics from scipy's complex ones, one index at a time; slow and obvious."""

import math

import numpy as np
from scipy.special import sph_harm_y


def real_harmonic(degree: int, m: int, direction: np.ndarray) -> float:
    """Return Y_lm at a unit direction [3]: sqrt(2) times the real (m > 0) or imaginary (m < 0) part.

    scipy includes the Condon-Shortley phase (-1)^m, which is removed.
    """
    polar, azimuth = math.acos(direction[2]), math.atan2(direction[1], direction[0])
    value = complex(sph_harm_y(degree, abs(m), polar, azimuth)) * (-1) ** m
    return value.real if m == 0 else math.sqrt(2) * (value.real if m > 0 else value.imag)
