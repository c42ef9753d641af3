import math
from collections.abc import Callable

import numpy as np
import pytest
import torch
from torch import Tensor

from facerf_cli.light.envmap import envmap_weights
from facerf_cli.light.forms import rig_to_latlong
from facerf_cli.light.sphere import (
    RigLight,
    azel_to_direction,
    direction_to_uv,
    latlong_directions,
    rig_directions,
)


def test_blender_reads_a_map_that_is_shifted_by_a_quarter() -> None:
    """As docs/integrations.md says, for a head in Blender's front view."""
    direction = azel_to_direction(54, 36).double()  # to the image's right, above, in front
    u, v = direction_to_uv(direction).tolist()
    envmap = torch.zeros(180, 360, 3)
    envmap[int(v * 180), int(u * 360)] = 1
    row, column = divmod(int(np.roll(envmap, 90, 1)[..., 0].argmax()), 360)
    x, y, z = direction[0], -direction[2], direction[1]  # Blender's: the head looks along -Y, Z up
    blender_u = 0.5 - math.atan2(y, x) / (2 * math.pi)
    blender_v = 1 - math.acos(z) / math.pi  # 1 at the top
    assert column + 0.5 == pytest.approx(blender_u * 360, abs=1)
    assert row + 0.5 == pytest.approx((1 - blender_v) * 180, abs=1)
    # In Blender 4.5 (bpy, Cycles) a spot at u = 0.6, 0.3 from the top lit a ball from (0.658, 0.595, 0.463).
    assert (blender_u, 1 - blender_v) == pytest.approx((0.6, 0.3), abs=1e-3)
    assert direction.tolist() == pytest.approx((0.658, 0.595, 0.463), abs=0.02)


RIG = rig_directions()


def back_and_forth(weights: Tensor, height: int) -> tuple[Tensor, float]:
    """The map of the rig's weights, and the largest error of the weights under it over the largest."""
    envmap = rig_to_latlong(RigLight(RIG, weights), height)
    assert envmap.shape == (height, 2 * height, 3)
    return envmap, float((envmap_weights(envmap, RIG) - weights).abs().max() / weights.abs().max())


def lone_lamps() -> Tensor:
    weights = torch.zeros(len(RIG), 3)
    weights[40], weights[90] = torch.tensor([1.0, 0.5, 0.2]), torch.tensor([0.1, 0.1, 0.5])
    return weights


def harsh_weights() -> Tensor:
    """Every light drawn by itself, most of them near black."""
    return torch.rand(len(RIG), 3, generator=torch.Generator().manual_seed(3)) ** 4


@pytest.mark.parametrize("draw, height", [(lone_lamps, 128), (harsh_weights, 300)])
def test_the_map_gives_the_weights_back(draw: Callable[[], Tensor], height: int) -> None:
    envmap, error = back_and_forth(draw(), height)
    assert error < 0.01
    assert float(envmap.min()) >= 0


def test_a_constant_light_is_a_constant_map_and_a_smooth_one_smooth() -> None:
    envmap, error = back_and_forth(envmap_weights(torch.full((4, 8, 3), 0.7), RIG), 128)
    assert error < 1e-6
    torch.testing.assert_close(envmap, torch.full_like(envmap, 0.7), rtol=1e-5, atol=0)
    truth = 1.5 + latlong_directions(128, 256)
    envmap, error = back_and_forth(envmap_weights(truth, RIG), 128)
    assert error < 1e-3
    assert float((envmap - truth).abs().max()) < 0.08  # steps from cell to cell would be 0.3 high


def test_signed_weights_come_back_without_spikes() -> None:
    weights = harsh_weights()
    envmap, _ = back_and_forth(weights, 128)
    cell = 4 * math.pi / len(RIG)
    assert float(envmap.max()) < 3 * math.pi * float(weights.max()) / cell  # near the mean over a cell
    _, error = back_and_forth(torch.randn(len(RIG), 3, generator=torch.Generator().manual_seed(4)), 128)
    assert error < 0.01


def test_a_lone_light_lies_about_its_direction() -> None:
    weights = torch.zeros(len(RIG), 3)
    weights[17] = 1
    envmap, _ = back_and_forth(weights, 128)
    directions = latlong_directions(128, 256)
    lit = envmap[..., 0] > 0.05 * envmap.max()
    assert float((directions[lit] @ RIG[17]).min()) > math.cos(math.radians(16))
    middle = (directions * envmap[..., :1] * directions[..., 1:2].pow(2).neg().add(1).sqrt()).sum((0, 1))
    assert float(torch.nn.functional.normalize(middle, dim=0) @ RIG[17]) > math.cos(math.radians(1.5))


def test_uneven_rigs_keep_their_power_and_lights_in_one_place_are_one() -> None:
    front = azel_to_direction(torch.tensor([0.0, 0, 30, -60, 10]), torch.tensor([0.0, 0, 10, 40, -70]))
    weights = torch.tensor([1.0, 2, 0, 4, 5])[:, None].expand(5, 3)
    taken = envmap_weights(rig_to_latlong(RigLight(front, weights), 128), front)
    torch.testing.assert_close(taken[:2].sum(0), torch.full((3,), 3.0), rtol=0.01, atol=0)
    torch.testing.assert_close(taken[2:], weights[2:], rtol=0, atol=0.05)
