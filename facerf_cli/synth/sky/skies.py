"""Clouds over a clear sky: broken cumulus and thin veils, lit by the sun that shines through the same sky.

Kinds of maps under the open sky: sun, dusk, overcast, night; for the units see `synth/sky/daylight.py`.

Procedural environment maps by seed and number: lat-long [H, 2 H, 3], scene-linear Rec.709.

The kinds are in `outdoors.py` and `interiors.py`; conventions of directions: `light/sphere.py`.
"""

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from facerf_cli.errors import UsageError
from facerf_cli.synth.sky.daylight import (
    SUN_RADIUS_DEG,
    SUN_SR,
    Grid,
    Random,
    Rectangle,
    disc,
    irradiance,
    look_up,
    make_grid,
    noise_tile,
    paint,
    preetham_sky,
    sun_irradiance,
    toward,
    warmth,
)
from facerf_cli.synth.sky.interiors import hall, stage, studio, windows
from facerf_cli.synth.sky.landscape import Land, draw_land, stand_under, sun_is_seen

_EARTH_KM = 6371.0
_SHARPNESS = 0.78  # Henyey and Greenstein's g of droplets, once softened by a few scatterings


@dataclass(frozen=True)
class Layer:
    """A sheet of cloud at one height, of optical depth by noise."""

    tile: np.ndarray  # [256, 256], deviation 1
    height_km: float
    tile_km: tuple[float, float]  # size of a tile along x and z: unlike for streaks
    threshold: float  # noise below it is clear
    depth: float  # optical depth a deviation above the threshold
    deepest: float

    def depths(self, directions: np.ndarray, shift_km: tuple[float, float] = (0.0, 0.0)) -> np.ndarray:
        """Optical depth [...] along directions [..., 3] above the horizon; `shift_km` (x, z) looks beside."""
        up = np.maximum(directions[..., 1], 0.01)
        reach = _EARTH_KM * up
        far_km = np.sqrt(reach**2 + 2 * _EARTH_KM * self.height_km + self.height_km**2) - reach
        x, z = (
            (directions[..., axis] * far_km + aside) / size
            for axis, aside, size in zip((0, 2), shift_km, self.tile_km, strict=True)
        )
        thickness = self.depth * np.clip(look_up(self.tile, x, z) - self.threshold, 0, None)
        return np.minimum(thickness, self.deepest) * np.clip((directions[..., 1] - 0.02) / 0.15, 0, 1)


def draw_layers(random: Random) -> list[Layer]:
    """No cloud, a veil, cumulus, or both, as the draw has it."""
    layers = []
    if random.random() < 0.5:
        tile, cover = noise_tile(random, 1.9, 3), random.uniform(0.05, 0.65)
        threshold = float(np.quantile(tile, 1 - cover))
        size_km = random.uniform(8, 25)
        layers.append(
            Layer(tile, random.uniform(1, 2.5), (size_km, size_km), threshold, random.uniform(2, 12), 25.0)
        )
    if random.random() < 0.5:
        tile, size_km = noise_tile(random, 1.4, 2), random.uniform(40, 90)
        stretch = random.uniform(1, 4)
        thick = float(np.exp(random.uniform(-3, 0.7)))
        layers.append(Layer(tile, 8.0, (size_km * stretch, size_km), random.uniform(-2, 0.5), thick, 4.0))
    return layers


def cover(
    grid: Grid, sky: np.ndarray, beam: np.ndarray, sun: np.ndarray, layers: list[Layer]
) -> tuple[np.ndarray, float]:
    """The sky [H, W, 3] with clouds before it, and the share of the sun's beam that comes through."""
    if not layers:
        return sky, 1.0
    top = len(sky) // 2 + 1  # rows that see the sky
    directions = grid.directions[:top]
    depth = np.asarray(sum(layer.depths(directions) for layer in layers))
    sun_depth = float(sum(layer.depths(sun[None])[0] for layer in layers))
    through = np.exp(-depth)[..., None]
    cos_gamma = directions @ sun
    lobe = (1 - _SHARPNESS**2) / (4 * np.pi * (1 + _SHARPNESS**2 - 2 * _SHARPNESS * cos_gamma) ** 1.5)
    up = np.array([0.0, 1.0, 0.0])
    lit = beam * max(float(sun[1]), 0.15) + irradiance(grid, sky, up)
    below = 0.9 / (1 + 0.06 * depth)  # diffuse light that leaves a cloud below: two streams, g near 0.9
    relief = np.tanh(
        0.25 * (depth - _toward_sun(directions, sun, layers))
    )  # sides toward the sun, and others
    below = below * (1 + 0.35 * relief)
    sides = 0.08 * np.clip(depth / 5, 0, 1) * (0.5 - 0.5 * cos_gamma) ** 2  # sunlit flanks, sun in our back
    cloud = below[..., None] * lit / np.pi + sides[..., None] * beam
    rim = (lobe * depth * np.exp(-depth))[..., None] * beam  # the silver lining
    covered = sky.copy()
    covered[:top] = sky[:top] * through + cloud * (1 - through) + rim
    return covered, float(np.exp(-sun_depth))


def _toward_sun(directions: np.ndarray, sun: np.ndarray, layers: list[Layer]) -> np.ndarray:
    """Optical depth [...] of what stands a little way toward the sun."""
    step = 0.05 * sun / max(float(np.hypot(sun[0], sun[2])), 1e-3)
    depths = (
        layer.depths(directions, (step[0] * layer.height_km, step[2] * layer.height_km)) for layer in layers
    )
    return np.asarray(sum(depths))


_LAMP_M, _EYE_M = 0.2, 1.6  # radius of a street lamp; height of the head
_NO_BEAM, _UP = np.zeros(3), np.array([0.0, 1.0, 0.0], np.float32)


def sun(grid: Grid, random: Random) -> np.ndarray:
    """A clear to hazy day: the sun from 2 to 75 degrees high, sky and clouds, land below."""
    turbidity = np.exp(random.uniform(np.log(2), np.log(8)))
    elevation_deg = float(random.choice([random.uniform(2, 20), random.uniform(15, 75)]))
    azimuth_deg = random.uniform(-180, 180)
    centre, beam = toward(azimuth_deg, elevation_deg), sun_irradiance(elevation_deg, turbidity)
    sky = preetham_sky(grid.directions, centre, turbidity)
    sky, share = cover(grid, sky, beam, centre, draw_layers(random))
    land = draw_land(random)
    beam = beam * share * sun_is_seen(land, azimuth_deg, elevation_deg)
    lit = stand_under(grid, sky, land, centre, beam)
    lit = lit + paint(disc(grid, centre, SUN_RADIUS_DEG), beam / SUN_SR)
    return np.asarray(lit * np.array([0.88, 1.0, 1.2]) ** random.uniform(0, 2.2))  # a camera's daylight white


def dusk(grid: Grid, random: Random) -> np.ndarray:
    """The sun at the horizon or below it: a glow over its azimuth, and the belt of Venus opposite.

    By eye, as Preetham's model ends where the sun sets.
    """
    azimuth_deg = random.uniform(-180, 180)
    centre = toward(azimuth_deg, 0)
    height = np.clip(grid.directions[..., 1], 0, 1)
    beside = 0.5 + 0.5 * np.cos(grid.azimuths_rad - np.radians(azimuth_deg))
    zenith_rgb = np.array([random.uniform(0.35, 0.85), 0.6, random.uniform(0.9, 1.4)])
    belt_rgb = np.array([1.0, 0.75, 0.95]) ** random.uniform(0, 1.7)
    glow_rgb = np.array([1.0, random.uniform(0.2, 0.55), random.uniform(0.03, 0.3)])
    glow = np.exp(random.uniform(1.3, 4.0)) * beside ** random.uniform(2, 20)
    belt = np.exp(-height / random.uniform(0.1, 0.4))
    low = np.exp(-height / random.uniform(0.05, 0.2))
    wide = (0.35 + 0.65 * beside) * (1 - 0.6 * height)
    sky = paint(wide * (1 - 0.6 * belt), zenith_rgb) + paint(wide * belt, belt_rgb)
    sky += paint(glow * low, glow_rgb)
    sky, _ = cover(grid, sky, 2 * glow_rgb * random.uniform(0, 1), centre, draw_layers(random))
    return stand_under(grid, sky, draw_land(random), centre, _NO_BEAM)


def overcast(grid: Grid, random: Random) -> np.ndarray:
    """CIE standard overcast sky (Moon and Spencer), (1 + 2 sin el) / 3, with billows and some sun."""
    height = np.clip(grid.directions[..., 1], 0, 1)
    hidden = toward(random.uniform(-180, 180), random.uniform(10, 70))
    hint = np.exp(random.uniform(-1.5, 2.2)) * (0.5 + 0.5 * grid.directions @ hidden) ** random.uniform(3, 25)
    tint = np.array([0.94, 1.0, 1.08]) ** random.uniform(0, 1.5)
    level = (1 + 2 * height) / 3 * (1 + hint)
    depths = sum(layer.depths(grid.directions) for layer in draw_layers(random))
    sky = paint(level * (0.55 + 0.45 * np.exp(-0.12 * np.asarray(depths))), tint)
    return stand_under(grid, sky, draw_land(random, houses=0.6), _UP, _NO_BEAM)


def night(grid: Grid, random: Random) -> np.ndarray:
    """A street: lamps of one kind in a row and lit windows, paving and houses, under a dim sky."""
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
    fronts = 0.15 * beam  # what stands beside the street, as if the lamps shone on it from our side
    lit = paint(pools, lamp_rgb) + 0.03 * beam  # and lamps farther on
    return stand_under(grid, sky, land, _UP, _NO_BEAM, fronts, lit) + lights


def _street_lamps(random: Random) -> tuple[np.ndarray, np.ndarray]:
    """Places [L, 3] (m, from the head) of lamps along a road, and their colour [3]."""
    lamp_rgb = np.array([[1.7, 1.0, 0.25], [1.3, 1.0, 0.6], [0.95, 1.0, 1.05]][random.integers(3)])
    lamps, road = random.integers(3, 12), toward(random.uniform(-180, 180), 0).astype(float)
    along_m, aside_m = random.uniform(-40, 40, lamps)[:, None], random.choice([-5, 5], lamps)[:, None]
    up = np.array([0, random.uniform(2.5, 6), 0])
    return along_m * road + aside_m * np.array([road[2], 0, -road[0]]) + up, lamp_rgb


def _pool(grid: Grid, place_m: np.ndarray) -> np.ndarray:
    """Irradiance [H, W] on the ground from a lamp of radiance 1."""
    down = np.minimum(grid.directions[..., 1:2], -0.003)
    away = place_m - grid.directions * (_EYE_M / -down)
    square = (away * away).sum(-1)
    share = np.clip(0.5 - grid.directions[..., 1] / grid.pixel_rad, 0, 1)
    return np.asarray(share * np.pi * _LAMP_M**2 * (place_m[1] + _EYE_M) / square**1.5)


def _lit_window(grid: Grid, random: Random, land: Land) -> np.ndarray | float:
    """A window somebody has lit, where a house stands."""
    azimuth_deg, share = random.uniform(-180, 180), random.uniform(0.2, 0.8)
    top_deg = float(np.degrees(land.top_rad(np.radians(azimuth_deg))))
    light = warmth(random, 0.3, 1) * np.exp(random.uniform(0, 3))
    if top_deg < 3:
        return 0.0
    pane = Rectangle(azimuth_deg, share * top_deg, 0.014, 0.02)
    return paint(pane.cover(grid.directions, grid.pixel_rad), light)


_PEAK = 60000.0  # what half floats hold, with room
KINDS: dict[str, Callable[[Grid, Random], np.ndarray]] = {
    kind.__name__: kind for kind in (sun, dusk, overcast, windows, hall, studio, night, stage)
}
# How often each is drawn, were there sixteen maps.
MIX = (*4 * ("sun",), *2 * ("dusk", "overcast", "windows", "hall", "studio"), "night", "stage")


def kind_of(index: int, seed: int, kinds: Sequence[str] = MIX) -> str:
    """The kind of the map with this index: a function of (seed, index) and nothing else."""
    return kinds[int(np.random.default_rng([seed, index, 0]).integers(len(kinds)))]


def draw_sky(index: int, seed: int, width_px: int, kinds: Sequence[str] = MIX) -> tuple[np.ndarray, str]:
    """A map [width / 2, width, 3] float32 and its kind; the same whatever was drawn before.

    Mean radiance over the sphere is 1, or less where the brightest pixel would leave the range of halves.
    """
    kind, grid = kind_of(index, seed, kinds), make_grid(width_px)
    radiance = KINDS[kind](grid, np.random.default_rng([seed, index, 1]))
    mean = (radiance.mean(-1) * grid.solid_angles_sr).sum() / (4 * np.pi)
    return (radiance / max(mean, radiance.max() / _PEAK)).astype(np.float32), kind


@dataclass(frozen=True)
class ProceduralMaps:
    """So many maps, each drawn when it is asked for."""

    maps: int
    seed: int
    width_px: int

    def __len__(self) -> int:
        return self.maps

    def __getitem__(self, index: int) -> np.ndarray:
        if not 0 <= index < self.maps:
            raise IndexError(index)
        return draw_sky(index, self.seed, self.width_px)[0]


def parse_envmaps(text: str, seed: int, width_px: int = 256) -> ProceduralMaps:
    """`procedural:N`, the word for maps that are drawn instead of read."""
    match = re.fullmatch(r"procedural:([1-9]\d{0,8})", text)
    if not match:
        raise UsageError(f"{text}: write procedural:N with a number of maps, such as procedural:100")
    return ProceduralMaps(int(match[1]), seed, width_px)
