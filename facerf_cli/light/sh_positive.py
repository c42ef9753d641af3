"""A light that can shine, nowhere negative, with given spherical-harmonic coefficients.

Coefficients cut off at an order ring below 0, and a face that is lit so goes black where it should be dim. Of
all non-negative lights that have the coefficients, the one of least power (least integral of its square) is a
harmonic series clipped at 0; its series is found from the coefficients by Newton's method on the convex dual.
"""

import numpy as np
import torch
from torch import Tensor

from facerf_cli.light.sh import order_of, sh_basis
from facerf_cli.light.sh_latlong import sh_to_latlong
from facerf_cli.light.sphere import golden_spiral

_RIDGE = 1e-3  # bounds the series where no non-negative light has the coefficients
_STEPS = 60
_SETTLED = 1e-8
_FEWEST_DIRECTIONS, _DIRECTIONS_A_COEFFICIENT = 2048, 10


def positive_latlong(coefficients: Tensor, height: int) -> Tensor:
    """The map [height, 2 height, 3] float32, not negative, whose coefficients are these [K, 3].

    To two or three hundredths where they are those of some light, mostly to a thousandth; else about the
    nearest that can be had.
    """
    return sh_to_latlong(clipped_series(coefficients), height).clamp(min=0)


def clipped_series(coefficients: Tensor) -> Tensor:
    """The series [K, 3] which, clipped at 0, has these coefficients [K, 3]."""
    order = order_of(coefficients)
    count = max(_FEWEST_DIRECTIONS, _DIRECTIONS_A_COEFFICIENT * len(coefficients))
    basis = sh_basis(torch.from_numpy(golden_spiral(count)), order).numpy()
    wanted = coefficients.double().cpu().numpy()
    scale = max(float(np.abs(wanted).max()), 1e-30)
    return torch.from_numpy(np.stack([_solve(basis, c / scale) for c in wanted.T], 1) * scale).float()


def _solve(basis: np.ndarray, wanted: np.ndarray) -> np.ndarray:
    """Least of half the integral of max(0, basis @ series)^2, less wanted @ series, and a small ridge."""
    area = 4 * np.pi / len(basis)
    series, lowest = wanted.copy(), np.inf
    step = np.zeros_like(series)
    for _ in range(_STEPS):
        light = (basis @ series).clip(min=0)
        value = 0.5 * area * light @ light + 0.5 * _RIDGE * series @ series - wanted @ series
        if value > lowest:  # too far: half way back
            step = step / 2
            series = series + step
            continue
        lowest = value
        gradient = area * basis.T @ light + _RIDGE * series - wanted
        if float(np.abs(gradient).max()) < _SETTLED:
            break
        lit = basis[light > 0]
        step = np.linalg.solve(area * lit.T @ lit + _RIDGE * np.eye(len(series)), gradient)
        series = series - step
    return series
