"""Light as real spherical harmonics of any order: coefficients of rigs, and back to rigs and maps.

`CONVENTION` is written into every file that holds coefficients. Coefficients [K, C], K = (order + 1)^2, are
c_lm = integral of L(d) Y_lm(d) over the sphere: radiance times steradian. A rig's light of weight w gives a
white surface that faces it radiance w (`light/sphere.py`), so it is a point of radiance times solid angle
pi w, and a rig and the map from which its weights were computed have about the same coefficients.
"""

import math

import numpy as np
import torch
from torch import Tensor

from facerf_cli.errors import InputError
from facerf_cli.light.sphere import RigLight, golden_spiral, latlong_directions, rig_directions

CONVENTION = (
    "real, orthonormal over the sphere, no Condon-Shortley phase, index l*l+l+m; camera axes "
    "(x right, y up, z toward the camera), polar axis +z, azimuth from +x to +y: degree 1 is sqrt(3/4pi) "
    "(y, z, x)"
)
MOST_ORDER = 20
_VALUES_AT_ONCE = 1 << 24  # of a large map, against memory
# Of the series that is clipped to a non-negative light.
_RIDGE = 1e-3  # bounds it if no non-negative light has the coefficients
_STEPS = 60  # of Newton's method
_SETTLED = 1e-8  # gradient at which it ends
_FEWEST_DIRECTIONS, _DIRECTIONS_PER_COEFFICIENT = 2048, 10  # of its quadrature


def sh_basis(directions: Tensor, order: int) -> Tensor:
    """Y_lm [..., (order + 1)^2] in unit directions [..., 3], in their precision; differentiable.

    scipy's sph_harm_y has no gradient and no GPU. These are polynomials in x, y, z, which are regular at
    the poles: the associated Legendre functions over sin^m theta by their recurrence in l (Sloan, *Stupid
    Spherical Harmonics Tricks*, 2008, appendix A1), times the real and imaginary part of (x + i y)^m.
    """
    if not 0 <= order <= MOST_ORDER:
        raise InputError(
            f"spherical harmonics of order {order}: not supported; give an order from 0 to {MOST_ORDER}"
        )
    x, y, z = directions.unbind(-1)
    basis: list[Tensor] = [z] * (order + 1) ** 2
    cosine, sine = torch.ones_like(z), torch.zeros_like(z)  # cos and sin of m azimuth, times sin^m theta
    for m in range(order + 1):
        for degree, legendre in enumerate(_legendre(z, m, order), start=m):
            middle = degree * degree + degree
            scale = math.sqrt(2) if m else 1.0
            basis[middle - m] = scale * legendre * sine
            basis[middle + m] = scale * legendre * cosine
        cosine, sine = x * cosine - y * sine, x * sine + y * cosine
    return torch.stack(basis, -1)


def _legendre(z: Tensor, m: int, order: int) -> list[Tensor]:
    """P_lm(z) / sin^m theta for l = m .. order, normalised so that the harmonics are orthonormal."""
    start = math.prod(math.sqrt((2 * k + 1) / (2 * k)) for k in range(1, m + 1)) / math.sqrt(4 * math.pi)
    values = [torch.full_like(z, start)]
    if order > m:
        values.append(math.sqrt(2 * m + 3) * z * values[0])
    for degree in range(m + 2, order + 1):
        a = math.sqrt((4 * degree**2 - 1) / (degree**2 - m**2))
        b = math.sqrt(((degree - 1) ** 2 - m**2) / (4 * (degree - 1) ** 2 - 1))
        values.append(a * (z * values[-1] - b * values[-2]))
    return values


def order_of(coefficients: Tensor) -> int:
    """The order of coefficients [K, ...]; raises InputError if K is not a square."""
    order = math.isqrt(len(coefficients)) - 1
    if order < 0 or (order + 1) ** 2 != len(coefficients):
        raise InputError(
            f"{len(coefficients)} spherical-harmonic coefficients: no order has so many; give 1, 4, 9, ..."
        )
    return order


def rig_coefficients(light: RigLight, order: int) -> Tensor:
    """Coefficients [..., K, 3] of a rig's lights [..., L, 3]: pi times the sum of w_l Y(d_l)."""
    basis = sh_basis(light.directions.double(), order)
    return (math.pi * basis.T @ light.weights.double()).float()


def coefficients_to_rig(coefficients: Tensor) -> RigLight:
    """The weights of least norm of the rig of the paper's 150 lights that have these coefficients [K, 3].

    Weights are signed, by the pseudo-inverse. `rig_coefficients` gives the coefficients back exactly up to
    order 11, and the nearest possible ones otherwise.
    """
    directions = rig_directions()
    basis = sh_basis(directions.double(), order_of(coefficients))
    weights = torch.linalg.pinv(math.pi * basis.T) @ coefficients.double()
    return RigLight(directions, weights.float())


def radiance(coefficients: Tensor, directions: Tensor) -> Tensor:
    """Radiance [..., 3] from unit directions [..., 3] of a light of coefficients [K, 3]."""
    return sh_basis(directions, order_of(coefficients)) @ coefficients.to(directions)


def irradiance(normals: Tensor, coefficients: Tensor) -> Tensor:
    """Irradiance [..., 3] on surfaces of unit normals [..., 3]; over pi it is a white surface's radiance.

    Ramamoorthi and Hanrahan, *An Efficient Representation for Irradiance Environment Maps*, 2001, Eq. 7.
    It may be slightly negative, as a truncated series is.
    """
    order = order_of(coefficients)
    lobe = torch.cat(
        [coefficients.new_full((2 * degree + 1, 1), cosine_lobe(degree)) for degree in range(order + 1)]
    )
    return radiance(coefficients * lobe, normals)


def cosine_lobe(degree: int) -> float:
    """A_l, the clamped cosine's factor at degree l (ibid., Eq. 8): pi, 2 pi / 3, pi / 4, 0, -pi / 24, ..."""
    if degree == 1:
        return 2 * math.pi / 3
    if degree % 2:
        return 0.0
    sign = -1 if degree % 4 == 0 else 1
    half = math.factorial(degree // 2)
    share = math.factorial(degree) / (2**degree * half * half)
    return 2 * math.pi * sign * share / ((degree + 2) * (degree - 1))


def rotated(coefficients: Tensor, turn: Tensor) -> Tensor:
    """Rotate a light of coefficients [K, 3] by `turn` [3, 3], which maps d to turn @ d.

    The result is a least-squares solution over more directions than coefficients. It is exact, since each
    degree is closed under rotation.
    """
    order = order_of(coefficients)
    directions = latlong_directions(order + 2, 2 * order + 4, torch.float64).reshape(-1, 3)
    came_from = directions @ turn.double().cpu()  # row by row: the inverse of the rotation
    turned = sh_basis(came_from, order) @ coefficients.double().cpu()
    return torch.linalg.lstsq(sh_basis(directions, order), turned, driver="gelsd").solution.to(coefficients)


def positive_latlong(coefficients: Tensor, height: int) -> Tensor:
    """A non-negative map [height, 2 height, 3] float32 with these coefficients [K, 3].

    A truncated series is negative in places, and a face that it lights has black parts. Of all non-negative
    lights with these coefficients, this is the one of least power (least integral of its square). If such
    lights exist, the coefficients of the map are within two or three hundredths, mostly within a thousandth;
    otherwise they are about the nearest possible.
    """
    series = clipped_series(coefficients)
    directions = latlong_directions(height, 2 * height, torch.float64).reshape(-1, 3)
    parts = torch.split(directions, max(1, _VALUES_AT_ONCE // len(series)))
    values = torch.cat([radiance(series, part) for part in parts])
    return values.float().reshape(height, 2 * height, 3).clamp(min=0)


def clipped_series(coefficients: Tensor) -> Tensor:
    """The series [K, 3] which, clipped at 0, has these coefficients [K, 3].

    The light of least power with given coefficients is a clipped series; Newton's method on the convex dual
    finds it.
    """
    order = order_of(coefficients)
    count = max(_FEWEST_DIRECTIONS, _DIRECTIONS_PER_COEFFICIENT * len(coefficients))
    basis = sh_basis(torch.from_numpy(golden_spiral(count)), order).numpy()
    wanted = coefficients.double().cpu().numpy()
    scale = max(float(np.abs(wanted).max()), 1e-30)
    return torch.from_numpy(np.stack([_solve(basis, c / scale) for c in wanted.T], 1) * scale).float()


def _solve(basis: np.ndarray, wanted: np.ndarray) -> np.ndarray:
    """Minimise half the integral of max(0, basis @ series)^2, minus wanted @ series, plus a small ridge."""
    area = 4 * np.pi / len(basis)
    series, lowest = wanted.copy(), np.inf
    step = np.zeros_like(series)
    for _ in range(_STEPS):
        light = (basis @ series).clip(min=0)
        value = 0.5 * area * light @ light + 0.5 * _RIDGE * series @ series - wanted @ series
        if value > lowest:  # too far: go half way back
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


def mirror_signs(count: int) -> Tensor:
    """Factors [K] of 1 and -1 by which coefficients change where x becomes -x."""
    probe = torch.tensor([[0.36, 0.48, 0.8]], dtype=torch.float64)
    order = math.isqrt(count) - 1
    first, mirrored = (sh_basis(probe * torch.tensor([sign, 1.0, 1.0]), order)[0] for sign in (1.0, -1.0))
    return (first * mirrored).sign().float()
