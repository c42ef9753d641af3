"""Kinds of procedural envmaps outdoors: sun, dusk, overcast, night.

Units differ by kind (kcd/m2 by day, relative ones otherwise); `skies.py` normalises the finished map.
"""

from dataclasses import replace

import numpy as np

from facerf_cli.synth.sky.clouds import add_clouds, draw_layers
from facerf_cli.synth.sky.daylight import SUN_RADIUS_DEG, SUN_SR, preetham_sky, sun_irradiance
from facerf_cli.synth.sky.landscape import EYE_M, Land, add_land, draw_land, sun_is_visible
from facerf_cli.synth.sky.painting import Grid, Random, Rectangle, disc, draw_white, paint, toward

_LAMP_M = 0.2  # radius of a street lamp
_NO_BEAM, _UP = np.zeros(3), np.array([0.0, 1.0, 0.0], np.float32)


def sun(grid: Grid, random: Random) -> np.ndarray:
    """Draw a clear to hazy day: sun at 2 to 75 degrees of elevation, clouds, and land."""
    turbidity = np.exp(random.uniform(np.log(2), np.log(8)))
    elevation_deg = float(random.choice([random.uniform(2, 20), random.uniform(15, 75)]))
    azimuth_deg = random.uniform(-180, 180)
    centre, beam = toward(azimuth_deg, elevation_deg), sun_irradiance(elevation_deg, turbidity)
    sky = preetham_sky(grid.directions, centre, turbidity)
    sky, share = add_clouds(grid, sky, beam, centre, draw_layers(random))
    land = draw_land(random)
    beam = beam * share * sun_is_visible(land, azimuth_deg, elevation_deg)
    lit = add_land(grid, sky, land, centre, beam)
    lit = lit + paint(disc(grid, centre, SUN_RADIUS_DEG), beam / SUN_SR)
    return np.asarray(lit * np.array([0.88, 1.0, 1.2]) ** random.uniform(0, 2.2))  # white balance of a camera


def dusk(grid: Grid, random: Random) -> np.ndarray:
    """Draw a sky with the sun at or below the horizon: a glow over it, and the belt of Venus opposite.

    The colours are chosen by eye: Preetham's model does not cover a sun below the horizon.
    """
    azimuth_deg = random.uniform(-180, 180)
    centre = toward(azimuth_deg, 0)
    height = np.clip(grid.directions[..., 1], 0, 1)
    toward_sun = 0.5 + 0.5 * np.cos(grid.azimuths_rad - np.radians(azimuth_deg))
    zenith_rgb = np.array([random.uniform(0.35, 0.85), 0.6, random.uniform(0.9, 1.4)])
    belt_rgb = np.array([1.0, 0.75, 0.95]) ** random.uniform(0, 1.7)
    glow_rgb = np.array([1.0, random.uniform(0.2, 0.55), random.uniform(0.03, 0.3)])
    glow = np.exp(random.uniform(1.3, 4.0)) * toward_sun ** random.uniform(2, 20)
    belt = np.exp(-height / random.uniform(0.1, 0.4))
    low = np.exp(-height / random.uniform(0.05, 0.2))
    wide = (0.35 + 0.65 * toward_sun) * (1 - 0.6 * height)
    sky = paint(wide * (1 - 0.6 * belt), zenith_rgb) + paint(wide * belt, belt_rgb)
    sky += paint(glow * low, glow_rgb)
    sky, _ = add_clouds(grid, sky, 2 * glow_rgb * random.uniform(0, 1), centre, draw_layers(random))
    return add_land(grid, sky, draw_land(random), centre, _NO_BEAM)


def overcast(grid: Grid, random: Random) -> np.ndarray:
    """Draw a CIE standard overcast sky (Moon and Spencer), (1 + 2 sin el) / 3, with clouds and faint sun."""
    height = np.clip(grid.directions[..., 1], 0, 1)
    hidden = toward(random.uniform(-180, 180), random.uniform(10, 70))
    hint = np.exp(random.uniform(-1.5, 2.2)) * (0.5 + 0.5 * grid.directions @ hidden) ** random.uniform(3, 25)
    tint = np.array([0.94, 1.0, 1.08]) ** random.uniform(0, 1.5)
    level = (1 + 2 * height) / 3 * (1 + hint)
    depths = sum(layer.depths(grid.directions) for layer in draw_layers(random))
    sky = paint(level * (0.55 + 0.45 * np.exp(-0.12 * np.asarray(depths))), tint)
    return add_land(grid, sky, draw_land(random, houses=0.6), _UP, _NO_BEAM)


def night(grid: Grid, random: Random) -> np.ndarray:
    """Draw a street at night: a row of street lamps, lit windows, paving and houses under a dim sky."""
    glow = random.uniform(0.005, 0.05)
    sky = paint(glow * (1.5 - np.clip(grid.directions[..., 1], 0, 1)), [0.9, 0.75, 0.8])
    land = draw_land(random, houses=0.9)
    land = replace(land, ground=np.full((2, 3), random.uniform(0.07, 0.25)) * [1.0, 0.97, 0.92])
    places_m, lamp_rgb = _street_lamps(random)
    lights, pools, beam = np.zeros_like(sky), np.zeros(sky.shape[:2]), np.zeros(3)
    for place_m in places_m:
        distance_m = float(np.linalg.norm(place_m))
        centre, radiance = place_m / distance_m, lamp_rgb * random.uniform(1000, 4000)
        lights += paint(disc(grid, centre, float(np.degrees(_LAMP_M / distance_m))), radiance)
        pools += _pool(grid, place_m) * radiance.mean() / lamp_rgb.mean()
        beam += radiance * np.pi * (_LAMP_M / distance_m) ** 2
    for _ in range(random.integers(0, 40)):
        lights += _lit_window(grid, random, land)
    fronts = 0.15 * beam  # light on houses, as if all lamps stood at the viewer
    lit = paint(pools, lamp_rgb) + 0.03 * beam  # the second term stands for lamps farther on
    return add_land(grid, sky, land, _UP, _NO_BEAM, fronts, lit) + lights


def _street_lamps(random: Random) -> tuple[np.ndarray, np.ndarray]:
    """Draw positions [L, 3] (m, from the head) of lamps along a road, and their colour [3]."""
    lamp_rgb = np.array([[1.7, 1.0, 0.25], [1.3, 1.0, 0.6], [0.95, 1.0, 1.05]][random.integers(3)])
    lamps, road = random.integers(3, 12), toward(random.uniform(-180, 180), 0).astype(float)
    along_m, aside_m = random.uniform(-40, 40, lamps)[:, None], random.choice([-5, 5], lamps)[:, None]
    up = np.array([0, random.uniform(2.5, 6), 0])
    return along_m * road + aside_m * np.array([road[2], 0, -road[0]]) + up, lamp_rgb


def _pool(grid: Grid, place_m: np.ndarray) -> np.ndarray:
    """Irradiance [H, W] on the ground from a street lamp of radiance 1."""
    down = np.minimum(grid.directions[..., 1:2], -0.003)
    away = place_m - grid.directions * (EYE_M / -down)
    square = (away * away).sum(-1)
    share = np.clip(0.5 - grid.directions[..., 1] / grid.pixel_rad, 0, 1)
    return np.asarray(share * np.pi * _LAMP_M**2 * (place_m[1] + EYE_M) / square**1.5)


def _lit_window(grid: Grid, random: Random, land: Land) -> np.ndarray | float:
    """Draw a lit window at a random azimuth; 0 where no house stands."""
    azimuth_deg, share = random.uniform(-180, 180), random.uniform(0.2, 0.8)
    top_deg = float(np.degrees(land.top_rad(np.radians(azimuth_deg))))
    light = draw_white(random, 0.3, 1) * np.exp(random.uniform(0, 3))
    if top_deg < 3:
        return 0.0
    pane = Rectangle(azimuth_deg, share * top_deg, 0.014, 0.02)
    return paint(pane.cover(grid.directions, grid.pixel_rad), light)
