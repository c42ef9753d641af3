import pytest
import torch

from facerf_cli.light.sh import (
    clipped_series,
    latlong_coefficients,
    positive_latlong,
    rig_coefficients,
    sh_to_latlong,
)
from facerf_cli.light.sphere import RigLight, rig_directions


def relative_error(found: torch.Tensor, truth: torch.Tensor) -> float:
    return float((found - truth).norm() / truth.norm())


@pytest.mark.parametrize("order", [1, 2, 4])
def test_the_coefficients_of_a_light_come_back_from_a_map_that_is_nowhere_negative(order: int) -> None:
    sky, single = torch.full((150, 3), 0.005), torch.zeros(150, 3)
    single[40] = torch.tensor([1.0, 0.8, 0.6])
    coefficients = rig_coefficients(RigLight(rig_directions(), sky + single), order)
    envmap = positive_latlong(coefficients, 64)
    assert envmap.shape == (64, 128, 3) and float(envmap.min()) >= 0
    assert relative_error(latlong_coefficients(envmap, order), coefficients) < 0.02
    series = sh_to_latlong(coefficients, 64)
    assert float(series.min()) < -0.01
    assert relative_error(latlong_coefficients(series.clamp(min=0), order), coefficients) > 0.02


def test_a_series_that_is_positive_stays_as_it_is() -> None:
    coefficients = torch.zeros(9, 3)
    coefficients[0], coefficients[3], coefficients[6] = 5.0, 1.0, -0.5
    torch.testing.assert_close(clipped_series(coefficients), coefficients, rtol=0, atol=6e-3)


def test_a_point_light_and_no_light_are_bounded() -> None:
    point = rig_coefficients(RigLight(rig_directions(7)[2:3], torch.ones(1, 3)), 2)
    envmap = positive_latlong(point, 64)
    assert float(envmap.max()) < 30 and relative_error(latlong_coefficients(envmap, 2), point) < 0.1
    assert float(positive_latlong(torch.zeros(9, 3), 8).abs().max()) == 0
    assert float(positive_latlong(torch.full((1, 3), -2.0), 8).max()) == 0
