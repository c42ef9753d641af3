import numpy as np
import pytest

from facerf_cli.errors import UsageError
from facerf_cli.stage.daylight import preetham_sky, sun_irradiance
from facerf_cli.stage.skies import KINDS, SUN_RADIUS_DEG, disc, draw_sky, make_grid, parse_envmaps, toward


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
def test_every_kind_is_finite_not_negative_and_of_mean_one(kind: str) -> None:
    for index in range(8):
        pixels, name = draw_sky(index, 3, 64, (kind,))
        assert name == kind and pixels.shape == (32, 64, 3) and pixels.dtype == np.float32
        assert np.isfinite(pixels).all() and pixels.min() >= 0 and pixels.max() <= 60001
        mean = (pixels.mean(-1) * make_grid(64).solid_angles_sr).sum() / (4 * np.pi)
        assert mean == pytest.approx(1, rel=1e-4)


def test_maps_depend_on_seed_and_index_alone() -> None:
    later = draw_sky(5, 1, 32)[0]
    draw_sky(0, 1, 32)
    assert np.array_equal(later, draw_sky(5, 1, 32)[0])
    assert not np.array_equal(later, draw_sky(5, 2, 32)[0])
    assert not np.array_equal(later, draw_sky(6, 1, 32)[0])


@pytest.mark.parametrize("index", range(6))
def test_a_sun_lights_alike_at_every_size(index: int) -> None:
    """Radiance to the first order of harmonics, 64 against 512 pixels wide."""
    moments = []
    for width_px in (64, 512):
        grid = make_grid(width_px)
        power = KINDS["sun"](grid, np.random.default_rng(index)).sum(-1) * grid.solid_angles_sr
        moments.append((power[..., None] * grid.directions).sum((0, 1)) / power.sum())
    assert np.linalg.norm(moments[0] - moments[1]) < 0.04


def test_the_brightest_sky_is_beside_the_sun_and_blue_far_from_it() -> None:
    grid, sun = make_grid(128), toward(0, 40)
    sky = preetham_sky(grid.directions, sun, 2.5)
    zenith = sky[0].mean(0)
    assert zenith[2] > 1.3 * zenith[0]
    row = np.unravel_index(sky[:32].sum(-1)[4:28].argmax(), (24, 128))
    assert grid.directions[row[0] + 4, row[1]] @ sun > 0.99


def test_a_low_sun_is_dimmer_and_redder() -> None:
    low, high = sun_irradiance(4, 3), sun_irradiance(60, 3)
    assert (low < high).all() and low[0] / low[2] > 2 * high[0] / high[2]
    assert 70 < high[1] < 110  # klx, as measured on clear days


def test_procedural_maps_are_drawn_lazily() -> None:
    maps = parse_envmaps("procedural:1000000", 7, 32)
    assert len(maps) == 1000000
    assert np.array_equal(maps[999999], draw_sky(999999, 7, 32)[0])
    with pytest.raises(IndexError):
        maps[1000000]


@pytest.mark.parametrize("text", ["procedural:", "procedural:0", "procedural:-3", "procedural:1e3", "sky:3"])
def test_a_bad_word_for_maps_is_refused(text: str) -> None:
    with pytest.raises(UsageError, match="procedural:N"):
        parse_envmaps(text, 0)
