import math

import pytest
import torch
from scipy.spatial import SphericalVoronoi, cKDTree

from facerf_cli.light.sphere import (
    RigLight,
    azel_to_direction,
    brightest_direction,
    direction_to_azel,
    direction_to_uv,
    latlong_directions,
    latlong_solid_angles,
    repelled,
    rig_directions,
    uv_to_direction,
)
from tests.refusals import refused

FIRST, LAST = [0.0327, 0.9846, 0.172], [-0.1174, -0.9846, 0.1299]


def nearest_neighbour_deg(rig: torch.Tensor) -> torch.Tensor:
    chord = torch.from_numpy(cKDTree(rig.numpy()).query(rig.numpy(), k=2)[0][:, 1])
    return torch.rad2deg(2 * torch.asin(chord / 2))


@pytest.mark.parametrize("lights", [16, 24, 32, 48, 150])
def test_a_stored_rig_is_as_computed(lights: int) -> None:
    computed = torch.from_numpy(repelled(lights)).float()
    torch.testing.assert_close(rig_directions(lights), computed, atol=1e-6, rtol=0)  # of float32


def test_the_rig_is_uniform_and_never_changes() -> None:
    rig = rig_directions(150)
    assert rig.shape == (150, 3) and rig.dtype == torch.float32
    torch.testing.assert_close(rig.norm(dim=-1), torch.ones(150))
    angles = nearest_neighbour_deg(rig)
    assert angles.min() > 16 and angles.max() < 18  # a hexagonal packing of 150 would have 17.8
    unit = torch.nn.functional.normalize(rig.double(), dim=-1).numpy()
    share = SphericalVoronoi(unit).calculate_areas() * 150 / (4 * math.pi)
    assert share.min() > 0.9 and share.max() < 1.1
    assert rig.mean(0).norm() < 0.01
    assert torch.equal(rig_directions(), rig_directions(150))
    first, last = rig_directions(150)[[0, 149]]
    torch.testing.assert_close(first, torch.tensor(FIRST), atol=1e-4, rtol=0)
    torch.testing.assert_close(last, torch.tensor(LAST), atol=1e-4, rtol=0)


@pytest.mark.parametrize("n, angle_deg", [(2, 180), (3, 120), (4, 109.47), (6, 90), (12, 63.43)])
def test_small_rigs_are_the_regular_ones(n: int, angle_deg: float) -> None:
    assert nearest_neighbour_deg(rig_directions(n)).min() == pytest.approx(angle_deg, abs=0.1)


def test_any_number_of_lights() -> None:
    assert torch.equal(rig_directions(1), torch.tensor([[0.0, 0, 1]]))
    for n in (5, 37, 600):
        assert nearest_neighbour_deg(rig_directions(n)).min() > 0.8 * math.degrees(math.sqrt(4 * math.pi / n))
    refused(ValueError, "at least one", rig_directions, 0)


@pytest.mark.parametrize(
    "azimuth, elevation, direction",
    [(0, 0, [0, 0, 1]), (90, 0, [1, 0, 0]), (-90, 0, [-1, 0, 0]), (0, 90, [0, 1, 0]), (180, 0, [0, 0, -1])],
)
def test_azimuth_and_elevation_by_hand(azimuth: float, elevation: float, direction: list[float]) -> None:
    torch.testing.assert_close(
        azel_to_direction(azimuth, elevation), torch.tensor(direction, dtype=torch.float32), atol=1e-6, rtol=0
    )


@pytest.mark.parametrize(
    "uv, direction",
    [((0.5, 0.5), [0, 0, 1]), ((0.25, 0.5), [1, 0, 0]), ((0.75, 0.5), [-1, 0, 0]), ((0.1, 0), [0, 1, 0])],
)
def test_the_map_is_openexrs_latlong(uv: tuple[float, float], direction: list[float]) -> None:
    torch.testing.assert_close(
        uv_to_direction(torch.tensor(uv)), torch.tensor(direction, dtype=torch.float32), atol=1e-6, rtol=0
    )


def test_round_trips() -> None:
    directions = rig_directions(500).double()
    back = azel_to_direction(*direction_to_azel(directions))
    torch.testing.assert_close(back, directions, atol=1e-6, rtol=0)
    back = uv_to_direction(direction_to_uv(3 * directions))
    torch.testing.assert_close(back, directions, atol=1e-6, rtol=0)


@pytest.mark.parametrize("height, width", [(1, 1), (4, 8), (5, 9), (128, 256)])
def test_solid_angles_are_exact(height: int, width: int) -> None:
    omega = latlong_solid_angles(height, width, torch.float64)
    assert omega.shape == (height, width)
    assert float(omega.sum()) == pytest.approx(4 * math.pi, rel=1e-12)
    directions = latlong_directions(height, width, torch.float64)
    assert directions.shape == (height, width, 3)
    if height > 100:
        second_moment = torch.einsum("hw,hwi,hwj->ij", omega, directions, directions)
        third = torch.eye(3, dtype=torch.float64) * 4 * math.pi / 3
        torch.testing.assert_close(second_moment, third, rtol=1e-3, atol=1e-3)


def _angle_deg(a: torch.Tensor, b: torch.Tensor) -> float:
    return float(torch.rad2deg(torch.dot(a, b).clamp(-1, 1).acos()))


def test_the_brightest_direction_is_where_one_light_or_two_are() -> None:
    rig = rig_directions()
    for light in (0, 40, 77, 149):
        weights = torch.full((150, 3), 0.01)
        weights[light] = torch.tensor([1.0, 0.8, 0.6])
        assert _angle_deg(brightest_direction(RigLight(rig, weights)), rig[light]) < 2
    near = (rig @ rig[60]).topk(3).indices
    weights = torch.zeros(150, 3)
    weights[near] = 0.7
    weights[(rig @ rig[60]).argmin()] = 1.0
    found = brightest_direction(RigLight(rig, weights))
    assert _angle_deg(found, torch.nn.functional.normalize(rig[near].sum(0), dim=0)) < 4
    rig = torch.tensor([[1.0, 0, 0], [-1.0, 0, 0]])
    light = RigLight(rig, torch.tensor([[0.0, 1.0, 0], [0, 0, 1.0]]))
    assert brightest_direction(light)[0] > 0.99
    assert (brightest_direction(RigLight(rig, torch.zeros(2, 3))) == 0).all()
