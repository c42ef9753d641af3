import math
from collections.abc import Callable
from functools import partial

import numpy as np
import pytest
import torch
from torch import Tensor

from facerf_cli.errors import InputError
from facerf_cli.light.entries import Sampling
from facerf_cli.light.envmap import (
    Backdrop,
    ball,
    check_envmap,
    envmap_weights,
    lights_around,
    rig_to_latlong,
    rig_triangles,
    rotated_weights,
    turned,
    without_keys,
)
from facerf_cli.light.sphere import (
    RigLight,
    azel_to_direction,
    direction_to_uv,
    latlong_directions,
    latlong_solid_angles,
    rig_directions,
)
from facerf_cli.raster.camera import Camera, pixel_rays, rays_of_rows
from tests.oracles.envmap import envmap_weights_slowly
from tests.refusals import refused

RIG = rig_directions()


def one_texel(height: int, uv: tuple[float, float]) -> torch.Tensor:
    """A map that lights a white surface facing that one texel with radiance 1."""
    envmap = torch.zeros(height, 2 * height, 3)
    row, column = int(uv[1] * height), int(uv[0] * 2 * height)
    envmap[row, column] = math.pi / latlong_solid_angles(height, 2 * height)[row, column]
    return envmap


def integral(envmap: torch.Tensor) -> torch.Tensor:
    return (envmap.double() * latlong_solid_angles(*envmap.shape[:2], torch.float64)[..., None]).sum((0, 1))


@pytest.mark.parametrize("height, width", [(1, 1), (1, 2), (4, 8), (7, 5), (300, 600), (512, 1500)])
@pytest.mark.parametrize("rotate_deg", [0, 17.3, -1000])
def test_pi_times_the_weights_is_the_maps_integral(height: int, width: int, rotate_deg: float) -> None:
    envmap = torch.rand(height, width, 3, generator=torch.Generator().manual_seed(height)) ** 4 * 100
    weights = envmap_weights(envmap, RIG, rotate_deg)
    torch.testing.assert_close(math.pi * weights.double().sum(0), integral(envmap), rtol=1e-6, atol=0)
    assert bool((weights >= 0).all())


def test_a_coarse_map_is_cut_at_the_cells_and_not_at_its_pixels() -> None:
    rotate_deg = 10.0
    envmap = torch.rand(4, 8, 3, generator=torch.Generator().manual_seed(5))
    truth = torch.from_numpy(envmap_weights_slowly(envmap.numpy(), RIG.numpy(), rotate_deg)).float()
    error = envmap_weights(envmap, RIG, rotate_deg) - truth
    assert error.abs().max() < 0.04 * truth.mean()
    assert error.std() < 0.01 * truth.mean()


@pytest.mark.parametrize("azimuth_deg, elevation_deg", [(30, 20), (-110, -45), (175, 60)])
def test_a_light_and_a_one_texel_map_agree(azimuth_deg: float, elevation_deg: float) -> None:
    light = azel_to_direction(azimuth_deg, elevation_deg)
    u, v = direction_to_uv(light).tolist()
    rig = torch.cat([light[None], -light[None], torch.linalg.cross(light, torch.tensor([0.6, 0, 0.8]))[None]])
    weights = envmap_weights(one_texel(128, (u, v)), rig)
    torch.testing.assert_close(weights, torch.tensor([[1.0], [0], [0]]).expand(3, 3), rtol=1e-5, atol=0)
    diffuse = ball(one_texel(128, (u, v)), 101, "diffuse")
    y, x = torch.meshgrid(50 - torch.arange(101.0), torch.arange(101.0) - 50, indexing="ij")
    normals = torch.stack([x, y, (50.5**2 - x * x - y * y).clamp(min=0).sqrt()], -1) / 50.5
    inner = normals[..., 2] > 0.3
    torch.testing.assert_close(diffuse[inner][:, 1], (normals @ light).clamp(min=0)[inner], rtol=0, atol=0.04)


def test_maps_are_turned_together_as_one_by_one() -> None:
    envmap = torch.rand(16, 32, 3)
    angles = [0, 12.5, 359]
    for sampling in ("cell", "paper"):
        many = rotated_weights(envmap, RIG, angles, sampling)
        single = torch.stack([envmap_weights(envmap, RIG, angle, sampling) for angle in angles])
        assert torch.equal(many, single)


def test_paper_sampling_takes_the_pixel_at_the_light() -> None:
    envmap = latlong_directions(256, 512) + 2  # each pixel says where it is
    for rotate_deg in (0, 45):
        weights = envmap_weights(envmap, RIG, rotate_deg, sampling="paper")
        seen = weights * len(RIG) / 4 - 2
        back = math.radians(-rotate_deg)
        turn = torch.tensor(
            [[math.cos(back), 0, math.sin(back)], [0, 1, 0], [-math.sin(back), 0, math.cos(back)]]
        )
        torch.testing.assert_close(seen, RIG @ turn.T, rtol=0, atol=0.02)
    envmap = latlong_directions(128, 256) + 2
    cell, paper = envmap_weights(envmap, RIG), envmap_weights(envmap, RIG, sampling="paper")
    assert (cell.sum(0) / paper.sum(0) - 1).abs().max() < 0.01


def test_balls_show_what_is_around_turned_and_in_its_brightness() -> None:
    envmap = latlong_directions(128, 256)
    mirror = ball(envmap, 61)
    torch.testing.assert_close(mirror[30, 30], torch.tensor([0.0, 0, 1]), rtol=0, atol=0.01)
    right = 30 + round(30.5 * math.sin(math.radians(45)))  # there the ball reflects straight to the right
    assert mirror[30, right, 0] > 0.98
    assert mirror[60 - right, 30, 1] > 0.98
    assert mirror[0, 0].abs().max() == 0
    for kind in ("mirror", "diffuse"):
        assert float(ball(torch.ones(8, 16, 3), 33, kind)[16, 16, 0]) == pytest.approx(1, rel=1e-3)
    lit = ball(one_texel(32, (0.5, 0.5)), 33, "diffuse", rotate_deg=90)
    assert lit[16, 30].mean() > 0.8 and lit[16, 2].mean() < 1e-3


@pytest.mark.parametrize("shape", [(4, 4, 3), (4, 8, 4), (8, 4, 3)])
def test_maps_of_the_wrong_shape_are_named(shape: tuple[int, ...]) -> None:
    refused(InputError, "twice as wide", check_envmap, torch.zeros(shape))


def test_broken_pixels_are_counted() -> None:
    envmap = torch.zeros(4, 8, 3)
    check_envmap(envmap)
    envmap[1, 2, 0], envmap[3, 3] = torch.nan, torch.inf
    refused(InputError, "2 NaN", check_envmap, envmap)


def _sun(rotations_deg: list[float], lights: int, sampling: Sampling) -> torch.Tensor:
    """Weights [R, L] of a small sun that turns."""
    envmap = torch.zeros(64, 128, 3)
    envmap[24, 40] = 50.0
    return rotated_weights(envmap, rig_directions(lights), rotations_deg, sampling)[..., 0]


def test_a_sun_that_turns_passes_smoothly_from_light_to_light(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("facerf_cli.light.envmap._LEAST_CELL_ROWS", 96)
    turns_deg = [0.5 * step for step in range(60)]
    smooth, cells = (_sun(turns_deg, 60, sampling) for sampling in ("smooth", "cell"))
    torch.testing.assert_close(smooth.sum(1), cells.sum(1))  # no light is lost
    most = [float((x.diff(dim=0).abs().sum(1) / x.sum(1)[1:]).max()) for x in (smooth, cells)]
    # lights are 26 degrees apart: half a degree moves a fiftieth of the sun out of one light and into others
    assert most[0] < 0.06 and most[1] > 0.3


def test_shares_of_a_direction_point_to_it() -> None:
    rig = rig_directions(40)
    towards = torch.nn.functional.normalize(torch.randn(500, 3, dtype=torch.float64), dim=1)
    index, share = lights_around(towards, rig)
    assert (share >= 0).all()
    torch.testing.assert_close(share.sum(1), torch.ones(500, dtype=torch.float64))
    mean = torch.nn.functional.normalize((share[..., None] * rig.double()[index]).sum(1), dim=1)
    torch.testing.assert_close(mean, towards, atol=1e-6, rtol=0)
    on_lights = lights_around(rig.double(), rig)
    best = on_lights[0].gather(1, on_lights[1].argmax(1, keepdim=True))[:, 0]
    assert best.tolist() == list(range(40))


def test_lights_around_in_a_rig_that_is_open_to_the_back() -> None:
    """As a light stage of a front half is: inside its triangles a direction is shared as in a whole rig."""
    rig = rig_directions(80)
    front = rig[rig[:, 2] > 0.3]
    inner = front[front[:, 2] > 0.75]
    towards = torch.nn.functional.normalize((inner[:, None] + inner[None]).flatten(0, 1), dim=1)
    index, share = lights_around(towards, front)
    mean = torch.nn.functional.normalize((share[..., None] * front.double()[index]).sum(1), dim=1)
    torch.testing.assert_close(mean, towards.double(), atol=1e-6, rtol=0)
    index, share = lights_around(torch.tensor([[0.0, 0, -1]]), front)
    assert share[0].tolist() == [1, 0, 0]
    corners = front.numpy()[rig_triangles(front.numpy())]
    assert len(corners) and corners.mean(1)[:, 2].min() > 0.3  # none closes the back


@pytest.mark.parametrize("lights", [[[0.0, 0, 1]], [[1.0, 0, 0], [0, 1, 0], [0, 0, 1], [0.6, 0.6, 0.53]]])
def test_directions_that_no_rig_surrounds_go_to_the_nearest_light(lights: list[list[float]]) -> None:
    rig = torch.tensor(lights)
    index, share = lights_around(torch.tensor([[0.0, 0, -1], [0.0, 0.1, 1.0]]), rig)
    assert share[0].tolist() == [1.0, 0.0, 0.0] and share.sum(1).tolist() == pytest.approx([1.0, 1.0])
    assert int(index[0, 0]) == int((rig @ torch.tensor([0.0, 0, -1])).argmax())


def seen(envmap: torch.Tensor, rotate_deg: float = 0.0, blur: float = 0.0) -> np.ndarray:
    camera = Camera(60.0, 60, 40, 30.0, 20.0)
    return Backdrop(envmap, (40, 60), partial(rays_of_rows, camera), rotate_deg, blur)[0:40]


def dot(direction: tuple[float, float, float]) -> torch.Tensor:
    """A dark map with a bright spot."""
    envmap = torch.full((64, 128, 3), 0.1)
    u, v = direction_to_uv(torch.tensor(direction)).tolist()
    envmap[int(v * 64), int(u * 128) % 128] = 50
    return envmap


def brightest(image: np.ndarray) -> tuple[int, int]:
    row, column = np.unravel_index(image.sum(-1).argmax(), image.shape[:2])
    return int(row), int(column)


def test_the_camera_looks_away_from_the_middle_and_right_is_right() -> None:
    row, column = brightest(seen(dot((0.0, 0.0, -1.0))))
    assert abs(row - 20) <= 3 and abs(column - 30) <= 3
    assert brightest(seen(dot((0.3, 0.0, -1.0))))[1] > 40
    assert brightest(seen(dot((0.0, 0.2, -1.0))))[0] < 14
    assert seen(dot((0.0, 0.0, 1.0))).max() < 0.2  # behind the camera
    # --rotate adds to every azimuth, where 90 degrees is the picture's right.
    assert brightest(seen(dot((0.0, 0.0, -1.0)), rotate_deg=-15))[1] > 40


def test_radiance_is_kept_and_blur_spreads_it() -> None:
    np.testing.assert_allclose(seen(torch.full((16, 32, 3), 0.7)), 0.7, rtol=1e-4)
    sharp, soft = seen(dot((0.0, 0.0, -1.0))), seen(dot((0.0, 0.0, -1.0)), blur=0.1)
    assert soft.shape == sharp.shape == (40, 60, 3) and soft.max() < 0.5 * sharp.max()
    np.testing.assert_allclose(soft.mean(), sharp.mean(), rtol=0.25)


def test_rays_and_backgrounds_of_rows_are_those_of_the_whole_image() -> None:
    camera = Camera(60.0, 60, 40, 30.0, 20.0)
    y, x = torch.meshgrid(torch.arange(40) + 0.5, torch.arange(60) + 0.5, indexing="ij")
    every = pixel_rays(torch.stack([x, y], -1), camera)
    assert torch.equal(rays_of_rows(camera, (40, 60), slice(8, 21)), every[8:21])
    halved = every.view(20, 2, 30, 2, 3).mean((1, 3))  # rays are linear in the pixels
    torch.testing.assert_close(rays_of_rows(camera, (20, 30), slice(0, 20)), halved)
    for blur in (0.0, 0.02, 0.1):
        rows = Backdrop(dot((0.0, 0.0, -1.0)), (40, 60), partial(rays_of_rows, camera), blur=blur)
        np.testing.assert_allclose(rows[8:21], rows[0:40][8:21], rtol=1e-6)


ROWS = 128
TOWARD = azel_to_direction(50.0, 35.0)
FEW = rig_directions(60)


def with_disc(radius_deg: float, share: float, toward: torch.Tensor = TOWARD) -> torch.Tensor:
    """A dim grey map with a coloured disc that has a share of all light."""
    towards, solid = latlong_directions(ROWS, 2 * ROWS), latlong_solid_angles(ROWS, 2 * ROWS)
    disc = torch.rad2deg((towards @ toward).clamp(-1, 1).acos()) < radius_deg
    grey = 0.1 * torch.ones(ROWS, 2 * ROWS, 1).expand(-1, -1, 3)
    added = share / (1 - share) * 0.1 * 4 * math.pi / solid[disc].sum()
    return grey + added * disc[..., None]


def test_a_sun_of_several_texels_is_one_key() -> None:
    envmap = with_disc(3.5, 0.4) * torch.tensor([1.2, 1.0, 0.6])
    _, found = without_keys(envmap)
    assert len(found.directions) == 1
    assert found.directions[0] @ TOWARD > math.cos(math.radians(0.5))
    power = (envmap - 0.1 * torch.tensor([1.2, 1.0, 0.6])).mul(
        latlong_solid_angles(ROWS, 2 * ROWS)[..., None]
    )
    assert found.weights[0].tolist() == pytest.approx((power.sum((0, 1)) / math.pi).tolist(), rel=0.02)


def test_the_rest_and_the_key_are_all_light() -> None:
    envmap = with_disc(3.5, 0.4)
    remaining, found = without_keys(envmap)
    whole, rest = (envmap_weights(one, FEW).sum(0) for one in (envmap, remaining))
    torch.testing.assert_close(rest + found.weights.sum(0), whole, rtol=1e-5, atol=0)
    assert remaining.max() < 0.11


@pytest.mark.parametrize("radius_deg, share", [(3.5, 0.15), (9.0, 0.5), (40.0, 0.9)])
def test_a_dim_light_and_a_wide_one_are_no_keys(radius_deg: float, share: float) -> None:
    envmap = with_disc(radius_deg, share)
    remaining, found = without_keys(envmap)
    assert remaining is envmap and not len(found.directions)


def test_two_suns_are_two_keys() -> None:
    other = azel_to_direction(-60.0, 10.0)
    _, found = without_keys(with_disc(2.5, 0.35) + with_disc(2.5, 0.5, other))
    assert (found.directions @ torch.stack([other, TOWARD]).T).diagonal().min() > 0.999


def test_texels_wider_than_a_key_are_none() -> None:
    envmap = torch.full((8, 16, 3), 0.01)
    envmap[3, 5] = 100
    assert without_keys(envmap)[0] is envmap


@pytest.mark.parametrize("rotate_deg", [-40.0, 200.0])
def test_keys_turn_as_the_map_does(rotate_deg: float) -> None:
    _, found = without_keys(with_disc(1.5, 0.4))
    wanted = azel_to_direction(50.0 + rotate_deg, 35.0)
    assert turned(found, rotate_deg).directions[0] @ wanted > math.cos(math.radians(0.8))


def test_gradients_reach_the_map() -> None:
    envmap = with_disc(3.5, 0.4).requires_grad_()
    remaining, found = without_keys(envmap)
    (found.weights.sum() + envmap_weights(remaining, FEW).sum()).backward()  # type: ignore[no-untyped-call]
    assert envmap.grad is not None
    solid = latlong_solid_angles(ROWS, 2 * ROWS)[..., None].expand(-1, -1, 3)
    torch.testing.assert_close(envmap.grad, solid / math.pi, rtol=1e-4, atol=1e-7)


def back_and_forth(weights: Tensor, height: int) -> tuple[Tensor, float]:
    """The map of the rig's weights, and the largest error of the weights under it over the largest."""
    envmap = rig_to_latlong(RigLight(RIG, weights), height)
    assert envmap.shape == (height, 2 * height, 3)
    return envmap, float((envmap_weights(envmap, RIG) - weights).abs().max() / weights.abs().max())


def single_lights() -> Tensor:
    weights = torch.zeros(len(RIG), 3)
    weights[40], weights[90] = torch.tensor([1.0, 0.5, 0.2]), torch.tensor([0.1, 0.1, 0.5])
    return weights


def harsh_weights() -> Tensor:
    """Every light drawn by itself, most of them near black."""
    return torch.rand(len(RIG), 3, generator=torch.Generator().manual_seed(3)) ** 4


@pytest.mark.parametrize("draw, height", [(single_lights, 128), (harsh_weights, 300)])
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
