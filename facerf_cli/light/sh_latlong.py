"""Spherical harmonics of a lat-long map, and the map of coefficients; the convention is `sh.CONVENTION`."""

import math

import numpy as np
import torch
from torch import Tensor

from facerf_cli.light.sh import order_of, radiance, rotated, sh_basis
from facerf_cli.light.sphere import latlong_directions

# Takes camera axes to those whose polar axis is the map's, +y, so that rows and columns part: (z, x, y).
_MAP_POLAR = torch.tensor([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]], dtype=torch.float64)
_VALUES_AT_ONCE = 1 << 24


def latlong_coefficients(envmap: Tensor, order: int) -> Tensor:
    """Coefficients [(order + 1)^2, 3] float32 of a map [H, W, 3], taken as constant over each pixel.

    The integral is exact across a row and by Gauss-Legendre quadrature down it, at any map size; it is taken
    about the map's own pole and turned to the convention's.
    """
    height, width = envmap.shape[:2]
    across = _across(width, order)  # [W, 2 order + 1]
    some_rows = torch.split(envmap.cpu(), max(1, _VALUES_AT_ONCE // (3 * width)))
    by_row = torch.cat([torch.einsum("hwc,wm->hmc", part.double(), across) for part in some_rows])
    about_pole = torch.einsum("hk,hkc->kc", _down(height, order), by_row[:, _column_of(order)])
    return rotated(about_pole, _MAP_POLAR.T).float()


def sh_to_latlong(coefficients: Tensor, height: int) -> Tensor:
    """Radiance [height, 2 height, 3] float32 at the pixels' centres; negative where a cut series is."""
    directions = latlong_directions(height, 2 * height, torch.float64).reshape(-1, 3)
    parts = torch.split(directions, max(1, _VALUES_AT_ONCE // len(coefficients)))
    order_of(coefficients)
    values = torch.cat([radiance(coefficients.cpu(), part) for part in parts])
    return values.float().reshape(height, 2 * height, 3)


def _column_of(order: int) -> Tensor:
    """order + m of every index l*l+l+m."""
    return torch.tensor([order + m for degree in range(order + 1) for m in range(-degree, degree + 1)])


def _across(width: int, order: int) -> Tensor:
    """Integrals over a pixel's azimuths [W, 2 order + 1] of cos(m azimuth), for m < 0 of sin(|m| azimuth)."""
    edges = math.pi * (1 - 2 * torch.arange(width + 1, dtype=torch.float64)[:, None] / width)
    m = torch.arange(1, order + 1, dtype=torch.float64)
    cosines = (m * edges).sin() / m
    sines = -(m * edges).cos() / m
    antiderivatives = torch.cat([sines.flip(1), edges, cosines], 1)
    return antiderivatives[:-1] - antiderivatives[1:]


def _down(height: int, order: int) -> Tensor:
    """Integrals over a row's elevations [H, K] of each harmonic's factor of elevation."""
    points = 8 + math.ceil(order * math.pi / height)
    nodes, weights = (torch.from_numpy(part) for part in np.polynomial.legendre.leggauss(points))
    step = math.pi / height
    middle = math.pi / 2 - (torch.arange(height, dtype=torch.float64) + 0.5) * step
    elevation = middle[:, None] + step / 2 * nodes
    ring = elevation.cos()
    at_azimuth_0 = sh_basis(torch.stack([ring, torch.zeros_like(ring), elevation.sin()], -1), order)
    index = [
        degree * degree + degree + abs(m) for degree in range(order + 1) for m in range(-degree, degree + 1)
    ]
    factors = torch.einsum("hqk,hq->hk", at_azimuth_0, weights * ring * step / 2)
    return factors[:, index]
