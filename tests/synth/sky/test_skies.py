import numpy as np
import pytest

from facerf_cli.errors import UsageError
from facerf_cli.synth.sky.interiors import RoomLights, draw_room
from facerf_cli.synth.sky.outdoors import (
    SUN_RADIUS_DEG,
    Land,
    Layer,
    Skyline,
    add_clouds,
    add_land,
    sun_is_visible,
)
from facerf_cli.synth.sky.painting import (
    Rectangle,
    disc,
    irradiance,
    make_grid,
    noise_tile,
    paint,
    ring_noise,
    sample_ring,
    sample_tile,
    toward,
)
from facerf_cli.synth.sky.skies import KINDS, MIX, draw_sky, kind_of, parse_envmaps
from tests.refusals import refused

UP, NO_BEAM = np.array([0.0, 1.0, 0.0]), np.zeros(3)


@pytest.mark.parametrize("width_px", [16, 64, 256, 1024])
@pytest.mark.parametrize("radius_deg", [SUN_RADIUS_DEG, 3.0, 20.0])
@pytest.mark.parametrize("elevation_deg", [2.0, 41.3, 88.0])
def test_a_disc_keeps_its_energy_and_place_at_any_size(
    width_px: int, radius_deg: float, elevation_deg: float
) -> None:
    grid, centre = make_grid(width_px), toward(33.3, elevation_deg)
    power = disc(grid, centre, radius_deg) * grid.solid_angles_sr
    assert power.sum() == pytest.approx(2 * np.pi * (1 - np.cos(np.radians(radius_deg))), rel=1e-6)
    mean = (power[..., None] * grid.directions).sum((0, 1))
    angle = np.arccos(np.clip(mean @ centre / np.linalg.norm(mean), -1, 1))
    assert angle < grid.pixel_rad


@pytest.mark.parametrize("kind", KINDS)
def test_every_kind_is_finite_of_mean_one_and_the_same_scene_at_any_size(kind: str) -> None:
    for index in range(8):
        pixels, name = draw_sky(index, 3, 64, (kind,))
        assert name == kind and pixels.shape == (32, 64, 3) and pixels.dtype == np.float32
        assert np.isfinite(pixels).all() and pixels.min() >= 0 and pixels.max() <= 60001
        mean = (pixels.mean(-1) * make_grid(64).solid_angles_sr).sum() / (4 * np.pi)
        assert mean == pytest.approx(1, rel=1e-4)
    # Irradiance from the six sides, 64 against 256 pixels wide.
    sides = np.concatenate([np.eye(3), -np.eye(3)])
    small, large = (
        irradiance(make_grid(width_px), draw_sky(4, 0, width_px, (kind,))[0], sides) for width_px in (64, 256)
    )
    assert np.abs(small - large).max() < 0.12 * large.max()


def test_kinds_are_drawn_in_their_share_by_seed_and_index_alone() -> None:
    later = draw_sky(5, 1, 32)[0]
    draw_sky(0, 1, 32)
    assert np.array_equal(later, draw_sky(5, 1, 32)[0])
    assert not np.array_equal(later, draw_sky(5, 2, 32)[0])
    assert not np.array_equal(later, draw_sky(6, 1, 32)[0])
    assert set(MIX) == set(KINDS)
    drawn = [kind_of(index, 0) for index in range(1500)]
    for kind in KINDS:
        assert drawn.count(kind) / 1500 == pytest.approx(MIX.count(kind) / len(MIX), abs=0.03)


@pytest.mark.parametrize("index", range(6))
def test_a_sun_lights_alike_at_every_size(index: int) -> None:
    """Radiance to the first order of harmonics, 64 against 512 pixels wide."""
    moments = []
    for width_px in (64, 512):
        grid = make_grid(width_px)
        power = KINDS["sun"](grid, np.random.default_rng(index)).sum(-1) * grid.solid_angles_sr
        moments.append((power[..., None] * grid.directions).sum((0, 1)) / power.sum())
    assert np.linalg.norm(moments[0] - moments[1]) < 0.04


def test_noise_is_periodic_and_a_rectangle_covers_its_solid_angle() -> None:
    random = np.random.default_rng(0)
    tile, ring = noise_tile(random), ring_noise(random, 1.0)
    assert tile.std() == pytest.approx(1, abs=1e-3) and ring.std() == pytest.approx(1)
    x = np.array([0.3, 1.3, -2.7])
    assert np.ptp(sample_tile(tile, x, 0 * x)) < 1e-3
    columns = sample_ring(make_grid(256), ring)
    assert abs(columns[0] - columns[-1]) < 4 * np.abs(np.diff(columns)).max()
    grid = make_grid(512)
    cover_sr = (
        Rectangle(40, 10, 0.3, 0.5).cover(grid.directions, grid.pixel_rad) * grid.solid_angles_sr
    ).sum()
    exact = 4 * np.arcsin(0.3 * 0.5 / np.sqrt((1 + 0.09) * (1 + 0.25)))
    assert cover_sr == pytest.approx(exact, rel=0.01)


def flat_land(grey: float, *skylines: Skyline) -> Land:
    return Land(np.full((2, 3), grey), np.zeros((256, 256), np.float32), 10.0, 0.0, skylines)


def test_ground_and_walls_reflect_what_falls_on_them() -> None:
    grid = make_grid(64)
    white = np.ones((32, 64, 3))
    wall = Skyline(np.full(2048, 0.5), np.full((2048, 3), 0.4), 0.0, 0.0)
    lit = add_land(grid, white, flat_land(0.5, wall), UP, NO_BEAM)
    np.testing.assert_allclose(lit[-8:], 0.5, rtol=0.01)  # under a sky of radiance 1
    np.testing.assert_allclose(lit[:8], 1.0)
    foot = 0.3 + 0.7 * float(grid.elevations_rad[13, 0]) / 0.5  # darker toward its foot
    np.testing.assert_allclose(lit[13], 0.4 * 0.75 * foot, rtol=0.02)  # half sees sky, half the ground
    sun = toward(0, 30).astype(float)
    lit = add_land(grid, 0 * white, flat_land(0.5, wall), sun, np.full(3, 2.0))
    np.testing.assert_allclose(lit[-8:], 0.5 / np.pi * 2.0 * 0.5, rtol=0.01)
    assert lit[13, 0, 0] > 3 * lit[13, 32, 0]  # what faces the sun, opposite to it


def test_skylines_and_clouds_hide_the_sun_and_rooms_are_brightest_near_their_light() -> None:
    tops = np.where(np.arange(2048) < 1024, 0.3, -0.01)  # azimuth 0 to 180 degrees
    land = flat_land(0.2, Skyline(tops, np.zeros((2048, 3)), 0.0, 0.0))
    assert not sun_is_visible(land, 90, 10) and sun_is_visible(land, 90, 30) and sun_is_visible(land, -90, 10)
    grid, sun = make_grid(64), toward(0, 50)
    sky, beam = np.full((32, 64, 3), 5.0) * [0.5, 1, 2], np.full(3, 80.0)
    tile = np.zeros((256, 256), np.float32)
    closed, share = add_clouds(grid, sky, beam, sun, [Layer(tile, 2.0, (10.0, 10.0), -1.0, 3.0, 25.0)])
    assert share == pytest.approx(np.exp(-3), rel=1e-3)
    assert closed[2, 32, 2] / closed[2, 32, 0] < 2  # bluish sky, whiter cloud
    none, share = add_clouds(grid, sky, beam, sun, [Layer(tile, 2.0, (10.0, 10.0), 1.0, 3.0, 25.0)])
    assert share == 1 and np.allclose(none, sky)
    grid, random = make_grid(64), np.random.default_rng(2)
    room, lights = draw_room(grid, random, (0.4, 0.5)), RoomLights(grid)
    centre = toward(70, 20)
    lights.add(centre, paint(disc(grid, centre, 4), [100.0, 100, 100]), flat=False)
    light = room.lit(lights).mean(-1) / room.albedo.mean(-1)
    brightest = grid.directions.reshape(-1, 3)[light.argmax()]
    assert brightest @ centre > 0.8
    assert np.isfinite(light).all() and light.min() > 0


def test_procedural_maps_are_drawn_lazily() -> None:
    maps = parse_envmaps("procedural:1000000", 7, 32)
    assert len(maps) == 1000000
    assert np.array_equal(maps[999999], draw_sky(999999, 7, 32)[0])
    with pytest.raises(IndexError):
        maps[1000000]


@pytest.mark.parametrize("text", ["procedural:", "procedural:0", "procedural:-3", "procedural:1e3", "sky:3"])
def test_a_wrong_number_of_maps_is_an_error(text: str) -> None:
    refused(UsageError, "procedural:N", parse_envmaps, text, 0)
