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


def project_slowly(envmap: np.ndarray, order: int, samples: int) -> np.ndarray:
    """Return coefficients [K, C] of a lat-long map [H, W, C], from samples x samples points a pixel."""
    height, width = envmap.shape[:2]
    coefficients = np.zeros(((order + 1) ** 2, envmap.shape[2]))
    rows, columns = height * samples, width * samples
    for i in range(rows):
        for j in range(columns):
            elevation = math.pi * (0.5 - (i + 0.5) / rows)
            azimuth = math.pi * (1 - 2 * (j + 0.5) / columns)
            ring = math.cos(elevation)
            direction = np.array([ring * math.sin(azimuth), math.sin(elevation), ring * math.cos(azimuth)])
            power = envmap[i // samples, j // samples] * ring * 2 * math.pi**2 / (rows * columns)
            for degree in range(order + 1):
                for m in range(-degree, degree + 1):
                    value = real_harmonic(degree, m, direction)
                    coefficients[degree * degree + degree + m] += power * value
    return coefficients
