"""Clouds over a clear sky: broken cumulus and thin veils, lit by the sun."""

from dataclasses import dataclass

import numpy as np

from facerf_cli.synth.sky.painting import Grid, Random, irradiance, noise_tile, sample_tile

_EARTH_KM = 6371.0  # radius
_SHARPNESS = 0.78  # g of Henyey and Greenstein's phase function, lowered to stand for multiple scattering


@dataclass(frozen=True)
class Layer:
    """A sheet of cloud at one height, with optical depth from noise."""

    tile: np.ndarray  # [256, 256] noise of standard deviation 1
    height_km: float
    tile_km: tuple[float, float]  # size of a tile along x and z; they differ for streaks
    threshold: float  # noise below it is clear sky
    depth: float  # optical depth per unit of noise above the threshold
    deepest: float  # upper bound of the optical depth

    def depths(self, directions: np.ndarray, shift_km: tuple[float, float] = (0.0, 0.0)) -> np.ndarray:
        """Compute optical depth [...] along directions [..., 3], at places shifted by `shift_km` (x, z)."""
        up = np.maximum(directions[..., 1], 0.01)
        reach = _EARTH_KM * up
        far_km = np.sqrt(reach**2 + 2 * _EARTH_KM * self.height_km + self.height_km**2) - reach
        x, z = (
            (directions[..., axis] * far_km + aside) / size
            for axis, aside, size in zip((0, 2), shift_km, self.tile_km, strict=True)
        )
        thickness = self.depth * np.clip(sample_tile(self.tile, x, z) - self.threshold, 0, None)
        return np.minimum(thickness, self.deepest) * np.clip((directions[..., 1] - 0.02) / 0.15, 0, 1)


def draw_layers(random: Random) -> list[Layer]:
    """Draw the cloud layers: cumulus and a veil, each in half of the skies."""
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


def add_clouds(
    grid: Grid, sky: np.ndarray, beam: np.ndarray, sun: np.ndarray, layers: list[Layer]
) -> tuple[np.ndarray, float]:
    """Composite clouds over a sky [H, W, 3], and return the share of the sun's beam that passes them."""
    if not layers:
        return sky, 1.0
    top = len(sky) // 2 + 1  # rows above the horizon
    directions = grid.directions[:top]
    depth = np.asarray(sum(layer.depths(directions) for layer in layers))
    sun_depth = float(sum(layer.depths(sun[None])[0] for layer in layers))
    through = np.exp(-depth)[..., None]
    cos_gamma = directions @ sun
    lobe = (1 - _SHARPNESS**2) / (4 * np.pi * (1 + _SHARPNESS**2 - 2 * _SHARPNESS * cos_gamma) ** 1.5)
    up = np.array([0.0, 1.0, 0.0])
    lit = beam * max(float(sun[1]), 0.15) + irradiance(grid, sky, up)
    below = 0.9 / (1 + 0.06 * depth)  # diffuse transmission, two-stream approximation, g near 0.9
    relief = np.tanh(0.25 * (depth - _toward_sun(directions, sun, layers)))  # brightens sides toward the sun
    below = below * (1 + 0.35 * relief)
    sides = 0.08 * np.clip(depth / 5, 0, 1) * (0.5 - 0.5 * cos_gamma) ** 2  # sunlit flanks, opposite the sun
    cloud = below[..., None] * lit / np.pi + sides[..., None] * beam
    rim = (lobe * depth * np.exp(-depth))[..., None] * beam  # forward scattering at thin edges
    covered = sky.copy()
    covered[:top] = sky[:top] * through + cloud * (1 - through) + rim
    return covered, float(np.exp(-sun_depth))


def _toward_sun(directions: np.ndarray, sun: np.ndarray, layers: list[Layer]) -> np.ndarray:
    """Optical depth [...] a small step toward the sun."""
    step = 0.05 * sun / max(float(np.hypot(sun[0], sun[2])), 1e-3)
    depths = (
        layer.depths(directions, (step[0] * layer.height_km, step[2] * layer.height_km)) for layer in layers
    )
    return np.asarray(sum(depths))
