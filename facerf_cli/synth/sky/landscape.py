"""Land below a procedural sky and lit by it: textured ground, and hills, trees and houses on the horizon."""

from dataclasses import dataclass, replace

import numpy as np

from facerf_cli.synth.sky.painting import (
    RING,
    Grid,
    Random,
    irradiance,
    noise_tile,
    ring_noise,
    sample_ring,
    sample_tile,
)

EYE_M = 1.6  # height of the head above the ground
# Linear RGB albedos of ground; the list repeats the common ones.
_ASPHALT, _SAND, _PAVING = (0.12, 0.12, 0.125), (0.38, 0.31, 0.22), (0.28, 0.26, 0.23)
_GRASS, _EARTH, _BRICK = (0.09, 0.12, 0.04), (0.22, 0.17, 0.12), (0.26, 0.13, 0.09)
_SNOW, _WATER = (0.75, 0.78, 0.82), (0.05, 0.06, 0.07)
_GROUNDS = (_ASPHALT, _SAND, _GRASS, _GRASS, _EARTH, _PAVING, _PAVING, _SNOW, _BRICK, _WATER)


@dataclass(frozen=True)
class Skyline:
    """A silhouette on the horizon: its upper edge and albedo at every azimuth."""

    tops_rad: np.ndarray  # [RING]; below 0 where there is nothing
    albedo: np.ndarray  # [RING, 3]
    haze: float  # share of the horizon sky's light that haze adds in front
    roughness: float  # standard deviation of the logarithm of the albedo between pixels
    windows: bool = False


@dataclass(frozen=True)
class Land:
    """Ground and skylines below a sky."""

    ground: np.ndarray  # [2, 3] two albedos, mixed by noise
    tile: np.ndarray  # [256, 256] noise
    patches_m: float  # size of a noise tile that mixes the albedos
    grain: float  # strength of the fine texture in the logarithm of the albedo
    skylines: tuple[Skyline, ...]  # farthest first

    def top_rad(self, azimuth_rad: float) -> float:
        """Elevation above which the sky is visible."""
        index = round(azimuth_rad / (2 * np.pi) * RING) % RING
        return max([0.0, *(float(line.tops_rad[index]) for line in self.skylines)])


def draw_land(random: Random, houses: float = 0.45) -> Land:
    """Draw ground and skylines; `houses` is the probability of houses."""
    pair = np.array([_GROUNDS[random.integers(len(_GROUNDS))] for _ in range(2)])
    pair[1] = pair[0] + random.choice([0.0, 0.25, 0.6]) * (pair[1] - pair[0])
    lines = [_hills(random)] if random.random() < 0.6 else []
    if random.random() < 0.65:
        lines.append(_trees(random))
    if random.random() < houses:
        lines.append(_houses(random))
    if random.random() < 0.2:
        lines.append(replace(_trees(random), haze=0.0))
    patches_m, grain = float(np.exp(random.uniform(1, 4.5))), random.uniform(0.05, 0.45)
    dark = np.exp(random.uniform(-1.3, 0.15))
    return Land(pair * dark, noise_tile(random, 1.5, 2), patches_m, grain, tuple(lines))


def _hills(random: Random) -> Skyline:
    high = np.radians(random.uniform(0.5, 7))
    tops = high * (0.6 + 0.35 * ring_noise(random, 1.6, 1, 120))
    albedo = np.array([0.07, 0.09, 0.05]) * random.uniform(0.6, 1.8) * [random.uniform(0.8, 1.8), 1, 1]
    return Skyline(tops, np.tile(albedo, (RING, 1)), random.uniform(0.15, 0.75), 0.25)


def _trees(random: Random) -> Skyline:
    """Draw the edge of a wood with gaps, or single trees."""
    clumps, leaves = ring_noise(random, 0.9, 2, 30), ring_noise(random, 0.7, 20, 500)
    bare = random.uniform(-1.2, 1.0)  # noise below it leaves the horizon open
    height = np.radians(np.exp(random.uniform(0.7, 3.1)))
    tops = height * (np.sqrt(np.clip(clumps - bare, 0, None)) * (0.8 + 0.13 * leaves)) - 0.002
    green = np.array([0.05, 0.07, 0.025]) * random.uniform(0.6, 1.6) * [random.uniform(0.8, 1.6), 1, 1]
    return Skyline(tops, np.tile(green, (RING, 1)), random.uniform(0, 0.2), 0.45)


def _houses(random: Random) -> Skyline:
    """Draw blocks and gables of plaster, brick and concrete."""
    tops, albedo = np.full(RING, -0.01), np.tile([0.1, 0.1, 0.1], (RING, 1))
    azimuth = np.arange(RING) * (2 * np.pi / RING)
    tall = np.exp(random.uniform(1.6, 3.5))
    for _ in range(random.integers(3, 28)):
        middle, half = random.uniform(0, 2 * np.pi), np.radians(random.uniform(1.5, 11))
        away = np.abs((azimuth - middle + np.pi) % (2 * np.pi) - np.pi) / half
        gable = random.choice([0.0, 0.35])
        high = np.radians(tall * random.uniform(0.4, 1.5)) * (1 - gable * np.minimum(away, 1))
        stands = (away < 1) & (high > tops)
        tops = np.where(stands, high, tops)
        plaster = random.uniform(0.12, 0.6) * np.array([1, 0.93, 0.83]) ** random.uniform(-0.3, 3)
        albedo[stands] = plaster
    return Skyline(tops, albedo, random.uniform(0, 0.15), 0.1, windows=True)


def add_land(
    grid: Grid,
    sky: np.ndarray,
    land: Land,
    sun: np.ndarray,
    beam: np.ndarray,
    fronts: np.ndarray | float = 0.0,
    pools: np.ndarray | float = 0.0,
) -> np.ndarray:
    """Composite the land over a sky [H, W, 3]; the sky and the sun's beam [3] (irradiance) light the land.

    `fronts` [3] is additional irradiance on skylines, `pools` [H, W, 3] on the ground. All surfaces are
    Lambertian. Skylines are lit as walls that face the viewer, and cast no shadow on the ground.
    """
    above = np.clip(grid.directions[..., 1:2] / grid.pixel_rad + 0.5, 0, 1)
    cosine_sr = (np.clip(grid.directions[..., 1], 0, None) * grid.solid_angles_sr)[..., None]
    level = (sky * cosine_sr).sum((0, 1)) + beam * max(float(sun[1]), 0)
    scene = above * sky + (1 - above) * _ground(grid, land, (level + pools) / np.pi)
    facing = np.stack([-np.sin(grid.azimuths_rad), np.zeros(sky.shape[1]), -np.cos(grid.azimuths_rad)], -1)
    upright = irradiance(grid, scene, facing) + np.clip(facing @ sun, 0, None)[:, None] * beam + fronts
    horizon = sky[len(sky) // 2 - max(1, len(sky) // 40) : len(sky) // 2].mean(0)
    for line in land.skylines:
        scene = _add_skyline(grid, scene, line, land.tile, upright / np.pi, horizon)
    return scene


def _ground(grid: Grid, land: Land, level: np.ndarray) -> np.ndarray:
    """Radiance [H, W, 3] of the ground, black above; `level` [H, W, 3] or [3] is that of a white ground."""
    half = len(grid.directions) // 2
    down = np.maximum(-grid.directions[half:, :, 1], 1e-3)
    x, z = (grid.directions[half:, :, axis] * (EYE_M / down) for axis in (0, 2))
    sharp = np.exp(-EYE_M / down * grid.pixel_rad / 0.15)  # far ground averages out in a pixel
    near = np.clip((down - 0.01) / 0.2, 0, 1)
    patches = np.clip(0.5 + 0.7 * near * sample_tile(land.tile, x / land.patches_m, z / land.patches_m), 0, 1)
    rough = sample_tile(land.tile, x / 1.7, z / 1.7)
    rough = rough - 1.5 * np.clip(-0.7 - rough, 0, None)  # shadow in hollows
    grain = np.exp(0.7 * land.grain * sharp * rough)
    mixed = land.ground[0] + (land.ground[1] - land.ground[0]) * patches[..., None]
    radiance = np.zeros(grid.directions.shape)
    radiance[half:] = mixed * grain[..., None] * np.broadcast_to(level, radiance.shape)[half:]
    return radiance


def _add_skyline(
    grid: Grid, scene: np.ndarray, line: Skyline, tile: np.ndarray, level: np.ndarray, horizon: np.ndarray
) -> np.ndarray:
    """Composite a skyline over the scene; `level` [W, 3] is the radiance of a white one."""
    tops = sample_ring(grid, line.tops_rad)
    elevation = grid.elevations_rad
    share = np.clip((tops - elevation) / grid.pixel_rad + 0.5, 0, 1)
    share = share * np.clip(elevation / grid.pixel_rad + 0.5, 0, 1) * (tops > 0)
    rows = np.flatnonzero(share.any(1))
    if not len(rows):
        return scene
    band = slice(rows[0], rows[-1] + 1)
    u, v = grid.azimuths_rad / (2 * np.pi), elevation[band] / (2 * np.pi)
    u, v = np.broadcast_arrays(u * 5, v * 5)
    texture = np.exp(line.roughness * sample_tile(tile, u, v))
    if line.windows:
        panes = (np.sin(u * 2 * np.pi * 32) > 0.1) & (np.sin(v * 2 * np.pi * 36) > 0.0)
        texture = np.where(panes, 0.35, texture)
    foot = np.clip(elevation[band] / np.maximum(tops, 1e-3), 0, 1)
    albedo = sample_ring(grid, line.albedo) * (0.3 + 0.7 * foot)[..., None]  # less light near the ground
    own = texture[..., None] * albedo * level * (1 - line.haze) + line.haze * horizon
    result = scene.copy()
    result[band] += share[band, :, None] * (own - scene[band])
    return result


def sun_is_visible(land: Land, azimuth_deg: float, elevation_deg: float) -> bool:
    """Return True if no skyline hides the centre of the sun."""
    return land.top_rad(float(np.radians(azimuth_deg))) < np.radians(elevation_deg)
