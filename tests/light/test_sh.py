import math

import numpy as np
import pytest
import torch
from torch import Tensor

from facerf_cli.errors import InputError
from facerf_cli.light.envmap import envmap_weights
from facerf_cli.light.sh import (
    coefficients_to_rig,
    cosine_lobe,
    irradiance,
    order_of,
    radiance,
    rig_coefficients,
    rotated,
    sh_basis,
)
from facerf_cli.light.sphere import RigLight, latlong_directions, latlong_solid_angles, rig_directions
from facerf_cli.raster.camera import pose_to_rotation
from tests.oracles.sh import real_harmonic
from tests.refusals import refused


def unit_vectors(count: int, seed: int = 1) -> Tensor:
    vectors = torch.randn(count, 3, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    return torch.nn.functional.normalize(vectors, dim=-1)


def drawn_coefficients(order: int, seed: int = 2) -> Tensor:
    draws = torch.Generator().manual_seed(seed)
    return torch.randn((order + 1) ** 2, 3, generator=draws, dtype=torch.float64)


def test_the_basis_is_scipys_and_its_degree_one_names_the_axes() -> None:
    directions = unit_vectors(5)
    basis = sh_basis(directions, 20)
    for row, direction in zip(basis.numpy(), directions.numpy(), strict=True):
        truth = [
            real_harmonic(degree, m, direction) for degree in range(21) for m in range(-degree, degree + 1)
        ]
        np.testing.assert_allclose(row, truth, rtol=0, atol=1e-13)
    first = sh_basis(unit_vectors(9), 1)[:, 1:] / math.sqrt(3 / (4 * math.pi))
    torch.testing.assert_close(first, unit_vectors(9)[:, [1, 2, 0]])


def test_the_basis_is_orthonormal_and_finite_with_its_gradient_at_the_poles() -> None:
    directions = latlong_directions(64, 128, torch.float64)
    basis = sh_basis(directions, 6).reshape(-1, 49)
    areas = latlong_solid_angles(64, 128, torch.float64).reshape(-1, 1)
    torch.testing.assert_close(basis.T @ (basis * areas), torch.eye(49).double(), rtol=0, atol=5e-3)
    poles = torch.tensor([[0.0, 0, 1], [0, 0, -1]], requires_grad=True)
    sh_basis(poles, 8).sum().backward()
    assert poles.grad is not None and bool(poles.grad.isfinite().all())


@pytest.mark.parametrize("order", [0, 2, 5, 11])
def test_a_rig_takes_coefficients_and_gives_them_back(order: int) -> None:
    coefficients = drawn_coefficients(order).float()
    light = coefficients_to_rig(coefficients)
    assert torch.equal(light.directions, rig_directions())
    torch.testing.assert_close(rig_coefficients(light, order), coefficients, rtol=0, atol=2e-6)


def test_a_light_of_weight_one_lights_a_facing_white_surface_with_about_one() -> None:
    towards = unit_vectors(1).float()
    coefficients = rig_coefficients(RigLight(towards, torch.tensor([[1.0, 0.5, 0]])), 20)
    lit = irradiance(towards, coefficients)[0] / math.pi
    torch.testing.assert_close(lit, torch.tensor([1.0, 0.5, 0]), rtol=0.01, atol=0)
    side = torch.nn.functional.normalize(torch.linalg.cross(towards, unit_vectors(1, 8).float()), dim=-1)
    assert float(irradiance(side, coefficients).abs().max()) / math.pi < 0.03  # a cut series rounds the kink


def test_irradiance_is_the_integral_of_the_published_lobe() -> None:
    coefficients, normals = drawn_coefficients(4), unit_vectors(20, 5)
    sources = latlong_directions(200, 400, torch.float64).reshape(-1, 3)
    areas = latlong_solid_angles(200, 400, torch.float64).reshape(-1, 1)
    truth = (normals @ sources.T).clamp(min=0) @ (radiance(coefficients, sources) * areas)
    torch.testing.assert_close(irradiance(normals, coefficients), truth, rtol=0, atol=2e-3)
    published = [3.141593, 2.094395, 0.785398, 0, -0.130900, 0, 0.049087]  # ibid., Eq. 8 and below
    assert [cosine_lobe(degree) for degree in range(7)] == pytest.approx(published, abs=1e-6)


def test_a_rotation_carries_each_direction_with_it() -> None:
    turn = pose_to_rotation(40, -25, 70).double()
    coefficients, directions = drawn_coefficients(9), unit_vectors(30)
    turned = rotated(coefficients, turn)
    there, before = radiance(turned, directions @ turn.T), radiance(coefficients, directions)
    torch.testing.assert_close(there, before, rtol=0, atol=1e-5)  # the rotation is a float32 one
    light = RigLight(directions.float(), torch.rand(30, 3))
    moved = RigLight((directions @ turn.T).float(), light.weights)
    torch.testing.assert_close(
        rotated(rig_coefficients(light, 5), turn), rig_coefficients(moved, 5), rtol=0, atol=1e-4
    )


def test_what_is_no_order_is_said() -> None:
    refused(InputError, "use 0 to 20", sh_basis, unit_vectors(1), 21)
    refused(InputError, "8 spherical-harmonic", order_of, torch.zeros(8, 3))
    assert order_of(torch.zeros(16, 3)) == 3


def map_coefficients(envmap: Tensor, order: int) -> Tensor:
    """Coefficients of a map [H, W, 3], each texel of which is a point light at its centre."""
    directions, areas = latlong_directions(*envmap.shape[:2]), latlong_solid_angles(*envmap.shape[:2])
    weights = envmap * areas[..., None] / math.pi
    return rig_coefficients(RigLight(directions.reshape(-1, 3), weights.reshape(-1, 3)), order)


def drawn(*shape: int) -> torch.Tensor:
    return torch.rand(*shape, generator=torch.Generator().manual_seed(sum(shape)))


def test_a_map_and_the_rig_that_weighs_it_shade_alike() -> None:
    envmap, rig = drawn(8, 16, 3), rig_directions()
    finer = envmap.repeat_interleave(16, 0).repeat_interleave(16, 1)
    of_map = map_coefficients(finer, 2)
    of_rig = rig_coefficients(RigLight(rig, envmap_weights(envmap, rig)), 2)
    normals = rig_directions(40)
    torch.testing.assert_close(irradiance(normals, of_map), irradiance(normals, of_rig), rtol=0.01, atol=0)
