import math

import numpy as np
import pytest
import torch

from facerf_cli.errors import InputError
from facerf_cli.light.envmap import envmap_weights
from facerf_cli.light.sh import (
    irradiance,
    latlong_coefficients,
    radiance,
    rig_coefficients,
    sh_basis,
    sh_to_latlong,
)
from facerf_cli.light.sphere import RigLight, latlong_directions, latlong_solid_angles, rig_directions
from tests.oracles.sh import project_slowly


def drawn(*shape: int) -> torch.Tensor:
    return torch.rand(*shape, generator=torch.Generator().manual_seed(sum(shape)))


def test_the_projection_is_the_slow_one() -> None:
    envmap = drawn(2, 4, 3)
    truth = torch.from_numpy(project_slowly(envmap.numpy().astype(np.float64), 3, samples=24)).float()
    torch.testing.assert_close(latlong_coefficients(envmap, 3), truth, rtol=0, atol=3e-3)


@pytest.mark.parametrize("height, width", [(1, 2), (3, 6), (40, 90)])
def test_the_projection_is_that_of_the_same_map_cut_finer(height: int, width: int) -> None:
    envmap = drawn(height, width, 3)
    finer = envmap.repeat_interleave(5, 0).repeat_interleave(7, 1)
    coarse, fine = latlong_coefficients(envmap, 20), latlong_coefficients(finer, 20)
    torch.testing.assert_close(coarse, fine, rtol=0, atol=1e-5)


def test_one_far_away_texel_is_a_point_light() -> None:
    envmap = torch.zeros(256, 512, 3)
    envmap[70, 130] = torch.tensor([1.0, 2, 3]) / latlong_solid_angles(256, 512)[70, 130]
    truth = sh_basis(latlong_directions(256, 512)[70, 130], 4)[:, None] * torch.tensor([1.0, 2, 3])
    torch.testing.assert_close(latlong_coefficients(envmap, 4), truth, rtol=0, atol=2e-3)


@pytest.mark.parametrize("order", [0, 2, 7])
def test_from_coefficients_to_a_map_and_back(order: int) -> None:
    coefficients = drawn((order + 1) ** 2, 3) - 0.5
    envmap = sh_to_latlong(coefficients, 128)
    torch.testing.assert_close(latlong_coefficients(envmap, order), coefficients, rtol=0, atol=2e-3)
    row, column = 30, 77
    here = radiance(coefficients, latlong_directions(128, 256)[row, column])
    torch.testing.assert_close(envmap[row, column], here)


def test_a_map_and_the_rig_that_weighs_it_shade_alike() -> None:
    envmap, rig = drawn(8, 16, 3), rig_directions()
    of_map = latlong_coefficients(envmap, 2)
    of_rig = rig_coefficients(RigLight(rig, envmap_weights(envmap, rig)), 2)
    normals = rig_directions(40)
    torch.testing.assert_close(irradiance(normals, of_map), irradiance(normals, of_rig), rtol=0.01, atol=0)
    constant = latlong_coefficients(torch.full((3, 6, 3), 0.7), 4)
    torch.testing.assert_close(irradiance(normals, constant) / math.pi, torch.full((40, 3), 0.7))


def test_what_is_no_order_is_said() -> None:
    with pytest.raises(InputError, match="from 0 to 20"):
        latlong_coefficients(torch.ones(4, 8, 3), 21)
    with pytest.raises(InputError, match="5 spherical-harmonic"):
        sh_to_latlong(torch.ones(5, 3), 4)
