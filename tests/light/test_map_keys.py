"""Keys of a map: which lights are some, and that they and the rest are all of the map's light."""

import math

import pytest
import torch

from facerf_cli.light.envmap import envmap_weights, without_keys
from facerf_cli.light.sphere import (
    azel_to_direction,
    latlong_directions,
    latlong_solid_angles,
    rig_directions,
)

ROWS = 128
TOWARD = azel_to_direction(50.0, 35.0)
RIG = rig_directions(60)


def with_disc(radius_deg: float, share: float, toward: torch.Tensor = TOWARD) -> torch.Tensor:
    """A dim grey map with a coloured disc that has a share of all light."""
    towards, solid = latlong_directions(ROWS, 2 * ROWS), latlong_solid_angles(ROWS, 2 * ROWS)
    disc = torch.rad2deg((towards @ toward).clamp(-1, 1).acos()) < radius_deg
    grey = 0.1 * torch.ones(ROWS, 2 * ROWS, 1).expand(-1, -1, 3)
    added = share / (1 - share) * 0.1 * 4 * math.pi / solid[disc].sum()
    return grey + added * disc[..., None]


def test_a_sun_of_several_texels_is_one_key() -> None:
    envmap = with_disc(3.5, 0.4) * torch.tensor([1.2, 1.0, 0.6])
    found = without_keys(envmap)
    assert len(found.directions) == 1
    assert found.directions[0] @ TOWARD > math.cos(math.radians(0.5))
    power = (envmap - 0.1 * torch.tensor([1.2, 1.0, 0.6])).mul(
        latlong_solid_angles(ROWS, 2 * ROWS)[..., None]
    )
    assert found.weights[0].tolist() == pytest.approx((power.sum((0, 1)) / math.pi).tolist(), rel=0.02)


def test_the_rest_and_the_key_are_all_light() -> None:
    envmap = with_disc(3.5, 0.4)
    found = without_keys(envmap)
    whole, rest = (envmap_weights(one, RIG).sum(0) for one in (envmap, found.rest))
    torch.testing.assert_close(rest + found.weights.sum(0), whole, rtol=1e-5, atol=0)
    assert found.rest.max() < 0.11


@pytest.mark.parametrize("radius_deg, share", [(3.5, 0.15), (9.0, 0.5), (40.0, 0.9)])
def test_a_dim_light_and_a_wide_one_are_no_keys(radius_deg: float, share: float) -> None:
    envmap = with_disc(radius_deg, share)
    found = without_keys(envmap)
    assert found.rest is envmap and not len(found.directions)


def test_two_suns_are_two_keys() -> None:
    other = azel_to_direction(-60.0, 10.0)
    found = without_keys(with_disc(2.5, 0.35) + with_disc(2.5, 0.5, other))
    assert (found.directions @ torch.stack([other, TOWARD]).T).diagonal().min() > 0.999


def test_texels_wider_than_a_key_are_none() -> None:
    envmap = torch.full((8, 16, 3), 0.01)
    envmap[3, 5] = 100
    assert without_keys(envmap).rest is envmap


@pytest.mark.parametrize("rotate_deg", [-40.0, 200.0])
def test_keys_turn_as_the_map_does(rotate_deg: float) -> None:
    turned = without_keys(with_disc(1.5, 0.4)).turned(rotate_deg)
    wanted = azel_to_direction(50.0 + rotate_deg, 35.0)
    assert turned.directions[0] @ wanted > math.cos(math.radians(0.8))


def test_gradients_reach_the_map() -> None:
    envmap = with_disc(3.5, 0.4).requires_grad_()
    found = without_keys(envmap)
    (found.weights.sum() + envmap_weights(found.rest, RIG).sum()).backward()  # type: ignore[no-untyped-call]
    assert envmap.grad is not None
    solid = latlong_solid_angles(ROWS, 2 * ROWS)[..., None].expand(-1, -1, 3)
    torch.testing.assert_close(envmap.grad, solid / math.pi, rtol=1e-4, atol=1e-7)
