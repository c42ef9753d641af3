"""Shadows of key lights by rays: where their edges lie, how soft they are, and that layers add up."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor

from facerf_cli.light.entries import StudioLight
from facerf_cli.light.light import KeyLight, Light, far_samples, stacked
from facerf_cli.light.sphere import azel_to_direction
from facerf_cli.person import Target
from facerf_cli.portrait.proxy import OFF_M, Proxy, ProxyMaps
from facerf_cli.relighting.cast_shadows import CastShadow, change, visibility
from facerf_cli.relighting.people_in_photo import PeopleInPhoto
from tests import astronaut

SIDE, WIDE_M = 96, 0.2  # of a floor, that faces the camera
PIXEL_M = WIDE_M / SIDE
EDGE_M = -0.02  # x of the right end of a board above the floor
SLANT_DEG = 30.0


def shadow_on_floor(above_m: float, ends: Tensor, near: bool = False) -> np.ndarray:
    """Visibility [SIDE] along x of a light on the floor, under a board from the left to `EDGE_M`."""
    corners = [[-1.0, -1, above_m], [EDGE_M, -1, above_m], [EDGE_M, 1, above_m], [-1.0, 1, above_m]]
    board = Proxy.of(torch.tensor(corners), torch.tensor([[0, 1, 2], [0, 2, 3]]))
    at = (torch.arange(SIDE) + 0.5) * PIXEL_M - WIDE_M / 2
    floor = torch.stack([at.expand(SIDE, -1), -at[:, None].expand(-1, SIDE), torch.zeros(SIDE, SIDE)])
    up = torch.tensor([0.0, 0.0, 1.0])[:, None, None].expand_as(floor)
    maps = ProxyMaps(up, floor, torch.ones(SIDE, SIDE))
    traced, coarse = np.ones((SIDE, SIDE), bool), torch.full((SIDE, SIDE), 0.7)
    return visibility(board, maps, traced, coarse, ends, near).view(SIDE, SIDE).mean(0).numpy()


def edge_m(visible: np.ndarray) -> float:
    """Place of a shadow's edge, by the area in shade."""
    return float((1 - visible).sum() * PIXEL_M - WIDE_M / 2)


@pytest.mark.parametrize("above_m", [0.03, 0.06])
def test_the_edge_of_a_shadow_lies_where_the_light_puts_it(above_m: float) -> None:
    slant = math.radians(SLANT_DEG)
    visible = shadow_on_floor(above_m, torch.tensor([[-math.sin(slant), 0.0, math.cos(slant)]]))
    shift_m = (above_m - OFF_M) * math.tan(slant)
    assert edge_m(visible) == pytest.approx(EDGE_M + shift_m, abs=PIXEL_M / 2)
    assert visible[0] == 0 and visible[-1] == 1 and (np.diff(visible) > -1e-6).all()
    soft = int(((visible > 0) & (visible < 1)).sum()) * PIXEL_M
    distance_m = above_m / math.cos(slant)
    assert soft == pytest.approx(
        2 * distance_m * math.tan(math.radians(3)) / math.cos(slant), abs=2 * PIXEL_M
    )


def test_edges_under_near_lights_are_in_line_and_under_large_ones_soft() -> None:
    place = torch.tensor([[-0.3, 0.0, 0.5]])
    visible = shadow_on_floor(0.05, place, near=True)
    x, _, height = place[0].tolist()
    reached = x + (EDGE_M - x) * (height - OFF_M) / (height - 0.05)
    assert edge_m(visible) == pytest.approx(reached, abs=PIXEL_M)
    below = torch.tensor([[-0.3, 0.0, 0.02]])  # under the board, which is not between
    assert (shadow_on_floor(0.05, below, near=True) == 1).all()
    light, small = (far_samples(StudioLight((-SLANT_DEG, 0.0), size_deg=size))[0] for size in (18.0, 0.0))
    soft, hard = (shadow_on_floor(0.06, ends) for ends in (light, small))
    wide = [int(((shadow > 0) & (shadow < 1)).sum()) for shadow in (soft, hard)]
    assert wide[0] > 2 * wide[1]
    assert edge_m(soft) == pytest.approx(edge_m(hard), abs=2 * PIXEL_M)
    # A board 2 mm above: the coarse visibility, .7, stays.
    visible = shadow_on_floor(OFF_M + 0.002, torch.tensor([[0.0, 0.0, 1.0]]))
    assert visible[:10] == pytest.approx(0.7, abs=1e-5) and visible[-1] == 1


def test_the_change_is_1_where_visibility_stays_and_bounded_elsewhere() -> None:
    fine, coarse, dark, light = torch.rand(4, 40, 40, generator=torch.Generator().manual_seed(2))
    same = change(CastShadow(torch.stack([coarse, coarse]), torch.stack([dark, light])))
    assert (same == 1).all()
    changed = change(CastShadow(torch.stack([fine, coarse]), torch.stack([0 * dark, 0.1 + light])))
    assert changed.min() >= 0 and 1.2 < changed.max() < 2
    assert (changed[fine < 0.9 * coarse] < 1).all() and (changed[fine > 1.1 * coarse] > 1).all()


def test_key_lights_are_singled_out() -> None:
    directions = torch.nn.functional.normalize(torch.rand(5, 3) + 0.1, dim=1)
    weights = torch.tensor([[1.0, 1, 0, 0, 0], [0.5, 0.5, 0, 2, 0.1], [0, 0, 0, 0, 0.3]])[..., None].expand(
        -1, -1, 3
    )
    lights = Light(directions, weights, keys=(slice(0, 2), slice(3, 4)))
    every, keys = lights.with_keys_alone()
    assert keys == [
        KeyLight(0, 0, False, slice(0, 2)),
        KeyLight(1, 3, False, slice(0, 2)),
        KeyLight(1, 4, False, slice(3, 4)),
    ]
    assert torch.equal(every.weights[:3], weights)
    assert every.weights[3:, :, 0].tolist() == [[0.5, 0.5, 0, 0, 0], [0, 0, 0, 2, 0]]
    near = (StudioLight(at_m=(0.0, 0.0, 1.0), size_m=0.2), StudioLight(at_m=(0.0, 0.0, 1.0), size_m=2.0))
    _, keys = replace(lights, near=near, near_weights=torch.ones(3, 2, 3)).with_keys_alone()
    assert [key for key in keys if key.is_near] == [
        KeyLight(n, at, True, slice(0, 1)) for n, at in ((0, 4), (1, 7), (2, 8))
    ]
    alone = torch.diag_embed(weights[1].T).permute(1, 2, 0)[3:4]  # a sum of its own
    _, keys = replace(lights, weights=torch.cat([weights[1:2], alone])).with_keys_alone()
    assert [key[:2] for key in keys] == [(0, 2), (0, 1), (1, 1)]


@pytest.fixture(scope="module")
def people() -> PeopleInPhoto:
    found = astronaut.person().prepare(Target(background="none"))
    assert isinstance(found, PeopleInPhoto)
    return found


def test_shadows_act_on_bare_skin_alone(people: PeopleInPhoto) -> None:
    """Elsewhere, and where the coarse visibility does not change, the image is that of the maps."""
    direction = azel_to_direction(45.0, 30.0)[None]
    ((relit,),) = people.relit(Light.each(direction, (slice(0, 1),)))
    ((alone, _),) = relit.keys
    assert alone.texture is relit.texture
    fine, coarse = (people.light_layer([one]) for one in (relit, replace(relit, keys=())))
    segmentation = astronaut.field().person.segmentation
    skin = sum(segmentation.layer(name)[:] for name in ("skin", "lips", "ears", "neck", "beard"))
    changed = (fine != coarse).any(-1)
    assert changed[skin > 0.9].mean() > 0.1 and changed[skin < 0.02].mean() < 0.01
    assert fine.min() >= 0


def test_layers_of_lights_add_up(people: PeopleInPhoto) -> None:
    directions = torch.cat([azel_to_direction(45.0, 30.0)[None], azel_to_direction(-80.0, 10.0)[None]])
    weights = torch.tensor([[1.0, 0.0], [0.0, 0.1], [1.0, 0.1]])[..., None].expand(-1, -1, 3)
    relit = people.relit(Light(directions, weights, keys=(slice(0, 1), slice(1, 2))))
    key, fill, both = map(people.light_layer, relit)
    assert fill.max() > 0.02
    np.testing.assert_allclose(both, key + fill, atol=1e-5 * both.max())


def test_a_bright_texel_of_a_map_casts_the_shadow_of_a_single_light(people: PeopleInPhoto) -> None:
    envmap = np.full((64, 128, 3), 0.02, np.float32)
    envmap[21, 47] = 300.0
    u, v = 47.5 / 128, 21.5 / 64
    single = Light.single(180 - 360 * u + 15, 90 - 180 * v)
    of_map = Light.from_envmap(envmap, rotate_deg=15, lights=6)
    shadows = []
    for light in (of_map, single):
        sharp, soft = (
            people.light_layer(next(people.relit(stacked([one])))) for one in (light, replace(light, keys=()))
        )
        shadows.append((sharp - soft) / light.weights[-1])
    assert abs(shadows[1]).max() > 0.05
    np.testing.assert_allclose(shadows[0], shadows[1], atol=2e-3 * abs(shadows[1]).max())
