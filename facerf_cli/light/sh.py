"""Light as real spherical harmonics: coefficients of rigs, and conversion back to rigs.

`CONVENTION` is written into every file with coefficients. Coefficients [K, C], K = (order + 1)^2, are c_lm =
integral of L(d) Y_lm(d) over the sphere: radiance times steradian. A rig's light of weight w gives a white
surface that faces it radiance w (`light/sphere.py`), so it is a point whose radiance times solid angle is pi
w. A rig and the map from which its weights were computed have about the same coefficients.
"""

import math

import torch
from torch import Tensor

from facerf_cli.errors import InputError
from facerf_cli.light.sphere import RigLight, latlong_directions, rig_directions

CONVENTION = (
    "real, orthonormal over the sphere, no Condon-Shortley phase, index l*l+l+m; camera axes "
    "(x right, y up, z toward the camera), polar axis +z, azimuth from +x to +y: degree 1 is sqrt(3/4pi) "
    "(y, z, x)"
)
MOST_ORDER = 20


def sh_basis(directions: Tensor, order: int) -> Tensor:
    """Return Y_lm [..., (order + 1)^2] in unit directions [..., 3], in their precision; differentiable.

    scipy's sph_harm_y has no gradient and no GPU support. These are polynomials in x, y, z, which are regular
    at the poles: the associated Legendre functions over sin^m theta by their recurrence in l (Sloan, *Stupid
    Spherical Harmonics Tricks*, 2008, appendix A1), times the real and imaginary part of (x + i y)^m.
    """
    if not 0 <= order <= MOST_ORDER:
        raise InputError(f"spherical harmonics of order {order}: not supported; use 0 to {MOST_ORDER}")
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
    """Return P_lm(z) / sin^m theta for l = m .. order, normalised so that the harmonics are orthonormal."""
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
    """Return the order of coefficients [K, ...]; raises InputError if K is not a square number."""
    order = math.isqrt(len(coefficients)) - 1
    if order < 0 or (order + 1) ** 2 != len(coefficients):
        count = f"{len(coefficients)} spherical-harmonic coefficients"
        raise InputError(f"{count}: not a square number; use 1, 4, 9, ...")
    return order


def rig_coefficients(light: RigLight, order: int) -> Tensor:
    """Return coefficients [..., K, 3] of a rig's lights [..., L, 3]: pi times the sum of w_l Y(d_l)."""
    basis = sh_basis(light.directions.double(), order)
    return (math.pi * basis.T @ light.weights.double()).float()


def coefficients_to_rig(coefficients: Tensor) -> RigLight:
    """Return the weights of least norm on the paper's 150-light rig that have these coefficients [K, 3].

    Weights are signed, from the pseudo-inverse. Up to order 11, `rig_coefficients` reproduces the
    coefficients exactly; beyond it, as closely as possible.
    """
    directions = rig_directions()
    basis = sh_basis(directions.double(), order_of(coefficients))
    weights = torch.linalg.pinv(math.pi * basis.T) @ coefficients.double()
    return RigLight(directions, weights.float())


def radiance(coefficients: Tensor, directions: Tensor) -> Tensor:
    """Return radiance [..., 3] from unit directions [..., 3] of a light with coefficients [K, 3]."""
    return sh_basis(directions, order_of(coefficients)) @ coefficients.to(directions)


def irradiance(normals: Tensor, coefficients: Tensor) -> Tensor:
    """Return irradiance [..., 3] on surfaces with unit normals [..., 3]; over pi, a white surface's radiance.

    Ramamoorthi and Hanrahan, *An Efficient Representation for Irradiance Environment Maps*, 2001, Eq. 7. A
    truncated series may be slightly negative.
    """
    order = order_of(coefficients)
    lobe = torch.cat(
        [coefficients.new_full((2 * degree + 1, 1), cosine_lobe(degree)) for degree in range(order + 1)]
    )
    return radiance(coefficients * lobe, normals)


def cosine_lobe(degree: int) -> float:
    """Return A_l, the clamped cosine's factor at degree l (ibid., Eq. 8): pi, 2 pi / 3, pi / 4, 0, ..."""
    if degree == 1:
        return 2 * math.pi / 3
    if degree % 2:
        return 0.0
    sign = -1 if degree % 4 == 0 else 1
    half = math.factorial(degree // 2)
    share = math.factorial(degree) / (2**degree * half * half)
    return 2 * math.pi * sign * share / ((degree + 2) * (degree - 1))


def rotated(coefficients: Tensor, turn: Tensor) -> Tensor:
    """Rotate a light with coefficients [K, 3] by `turn` [3, 3], which maps d to turn @ d.

    The result is a least-squares solution over more directions than coefficients. It is exact, because each
    degree is closed under rotation.
    """
    order = order_of(coefficients)
    directions = latlong_directions(order + 2, 2 * order + 4, torch.float64).reshape(-1, 3)
    came_from = directions @ turn.double().cpu()  # row by row: the inverse of the rotation
    turned = sh_basis(came_from, order) @ coefficients.double().cpu()
    return torch.linalg.lstsq(sh_basis(directions, order), turned, driver="gelsd").solution.to(coefficients)


def mirror_signs(count: int) -> Tensor:
    """Return the factors [K], 1 or -1, of coefficients when x becomes -x."""
    probe = torch.tensor([[0.36, 0.48, 0.8]], dtype=torch.float64)
    order = math.isqrt(count) - 1
    first, mirrored = (sh_basis(probe * torch.tensor([sign, 1.0, 1.0]), order)[0] for sign in (1.0, -1.0))
    return (first * mirrored).sign().float()
