"""What procedural maps are painted with: the grid of a map, discs, rectangles and noise that no grid shapes.

Lat-long [H, 2 H, 3], scene-linear Rec.709. Conventions of directions: `light/sphere.py`. Scenes are functions
of direction, so that a map's size changes its resolution and not what it shows.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from scipy.ndimage import map_coordinates

from facerf_cli.light.sphere import latlong_directions, latlong_solid_angles

Random = np.random.Generator
_TILE_PX = 256


@dataclass(frozen=True)
class Grid:
    """The pixels of a map of some size."""

    directions: np.ndarray  # [H, W, 3] float32
    solid_angles_sr: np.ndarray  # [H, W] float64

    @property
    def pixel_rad(self) -> float:
        """Height of a pixel."""
        return np.pi / len(self.directions)

    @property
    def azimuths_rad(self) -> np.ndarray:
        """Azimuth of every column [W]."""
        return np.asarray(np.arctan2(self.directions[0, :, 0], self.directions[0, :, 2]))

    @property
    def elevations_rad(self) -> np.ndarray:
        """Elevation of every row [H, 1]."""
        return np.arcsin(np.clip(self.directions[:, :1, 1], -1, 1))


@lru_cache(maxsize=2)
def make_grid(width_px: int) -> Grid:
    """The grid of maps [width / 2, width, 3]."""
    height_px = width_px // 2
    directions = latlong_directions(height_px, width_px).numpy()
    return Grid(directions, latlong_solid_angles(height_px, width_px).double().numpy())


def toward(azimuth_deg: float, elevation_deg: float) -> np.ndarray:
    """Unit direction [3], as in DESIGN."""
    az, el = np.radians([azimuth_deg, elevation_deg])
    return np.array([np.cos(el) * np.sin(az), np.sin(el), np.cos(el) * np.cos(az)], np.float32)


def disc(grid: Grid, centre: np.ndarray, radius_deg: float) -> np.ndarray:
    """Coverage [H, W] of a round light: over the solid angles it sums to the disc's own at any map size.

    Below a pixel the coverage spreads over the nearest pixels, so that no light falls between centres.
    """
    radius = np.radians(radius_deg)
    chord = np.linalg.norm(grid.directions - centre, axis=-1)
    angle = 2 * np.arcsin(np.clip(chord / 2, 0, 1))  # acos would lose small angles to rounding
    soft = np.clip(1 + (radius - angle) / grid.pixel_rad, 0, 1)
    exact_sr = 2 * np.pi * (1 - np.cos(radius))
    return np.asarray(soft * (exact_sr / (soft * grid.solid_angles_sr).sum()))


@dataclass(frozen=True)
class Rectangle:
    """A flat rectangle of half sizes `wide` and `high` at distance 1, facing us."""

    azimuth_deg: float
    elevation_deg: float
    wide: float
    high: float

    @property
    def centre(self) -> np.ndarray:
        """Direction of its middle [3]."""
        return toward(self.azimuth_deg, self.elevation_deg)

    def place(self, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Position to the right and up in half sizes [...], and whether it lies ahead, of [..., 3]."""
        ahead, right = self.centre, toward(self.azimuth_deg + 90, 0)
        depth = directions @ ahead
        safe = np.maximum(depth, 1e-3)
        across = directions @ right / (safe * self.wide)
        return across, directions @ np.cross(ahead, right) / (safe * self.high), depth > 0.05

    def cover(self, directions: np.ndarray, edge: float) -> np.ndarray:
        """Coverage [...] of directions [..., 3], with borders as soft as `edge` (radians)."""
        x, y, ahead = self.place(directions)
        across = np.clip((1 - np.abs(x)) * (self.wide / edge) + 0.5, 0, 1)
        along = np.clip((1 - np.abs(y)) * (self.high / edge) + 0.5, 0, 1)
        return np.asarray(across * along * ahead)


def paint(amount: np.ndarray, rgb: np.ndarray | Sequence[float]) -> np.ndarray:
    """Light of one colour [H, W, 3] where amount [H, W] is."""
    return amount[..., None] * np.asarray(rgb)


def warmth(random: Random, cold: float = 0.0, warm: float = 1.0) -> np.ndarray:
    """A lamp's white [3], green 1: from bluish daylight (0) to tungsten (1)."""
    share = random.uniform(cold, warm)
    return np.array([0.9 + 0.8 * share, 1.0, 1.15 - 0.8 * share])


def irradiance(grid: Grid, radiance: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """Irradiance [..., 3] on normals [..., 3] under a smooth map, to the first order of harmonics."""
    power = radiance * grid.solid_angles_sr[..., None]
    mean, slope = power.sum((0, 1)) / 4, np.einsum("hwd,hwc->dc", grid.directions, power) / 2
    return np.asarray(np.clip(mean + normals @ slope, 0, None))


def noise_tile(random: Random, slope: float = 1.7, coarsest: float = 3.0) -> np.ndarray:
    """Fractal noise [256, 256] float32 that tiles, of mean 0 and deviation 1.

    Amplitude falls as frequency to the power -slope from `coarsest` periods a tile on.
    """
    rows, columns = np.fft.fftfreq(_TILE_PX)[:, None], np.fft.rfftfreq(_TILE_PX)
    frequency = np.hypot(rows, columns) * _TILE_PX
    shape = np.where(frequency > 0, np.maximum(frequency, coarsest) ** -slope, 0)
    spectrum = np.fft.rfft2(random.standard_normal((_TILE_PX, _TILE_PX))) * shape
    tile = np.fft.irfft2(spectrum, s=(_TILE_PX, _TILE_PX))
    return np.asarray(tile / tile.std(), np.float32)


def look_up(tile: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """A tile at positions in tiles [...], bilinear and periodic."""
    size = len(tile)
    return np.asarray(map_coordinates(tile, [y * size, x * size], order=1, mode="grid-wrap"))


def ring_noise(random: Random, slope: float, coarsest: int = 1, finest: int = 400) -> np.ndarray:
    """Fractal noise over the azimuth [2048], periodic, of mean 0 and deviation 1."""
    frequency = np.arange(1025.0)
    shape = np.where((frequency >= coarsest) & (frequency <= finest), np.maximum(frequency, 1) ** -slope, 0)
    ring = np.fft.irfft(shape * np.exp(2j * np.pi * random.random(1025)), n=2048)
    return np.asarray(ring / ring.std())


def around(grid: Grid, ring: np.ndarray) -> np.ndarray:
    """A function of azimuth [2048], or several [2048, C], at the map's columns."""
    place = (grid.azimuths_rad / (2 * np.pi) % 1) * len(ring)
    low = np.floor(place).astype(int)
    share = (place - low).reshape(-1, *[1] * (ring.ndim - 1))
    return np.asarray(ring[low % len(ring)] * (1 - share) + ring[(low + 1) % len(ring)] * share)
