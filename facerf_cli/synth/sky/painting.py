"""Painting tools of procedural envmaps: the pixel grid, discs, rectangles and noise.

Maps are lat-long images [H, 2 H, 3], scene-linear Rec.709. `light/sphere.py` defines their directions.
Everything is a function of direction, so that the size of a map changes its resolution and not its content.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from scipy.ndimage import map_coordinates

from facerf_cli.light.sphere import latlong_directions, latlong_solid_angles
from facerf_cli.synth.random_fields import Random

RING = 2048  # samples of a function of azimuth
_TILE_PX = 256


@dataclass(frozen=True)
class Grid:
    """Pixels of a lat-long map."""

    directions: np.ndarray  # [H, W, 3] float32
    solid_angles_sr: np.ndarray  # [H, W] float64

    @property
    def pixel_rad(self) -> float:
        """Height of a pixel, in radians."""
        return np.pi / len(self.directions)

    @property
    def azimuths_rad(self) -> np.ndarray:
        """Azimuth of every column [W]."""
        return np.asarray(np.arctan2(self.directions[0, :, 0], self.directions[0, :, 2]))

    @property
    def elevations_rad(self) -> np.ndarray:
        """Elevation of every row [H, 1]."""
        return np.arcsin(np.clip(self.directions[:, :1, 1], -1, 1))

    def share(self, depth_rad: np.ndarray) -> np.ndarray:
        """Return the share [...] of a pixel that lies inside an edge, from its centre's depth inside."""
        return np.asarray(np.clip(depth_rad / self.pixel_rad + 0.5, 0, 1))


@lru_cache(maxsize=2)  # all maps of a run share it
def make_grid(width_px: int) -> Grid:
    """Build the pixel grid of maps [width / 2, width, 3]."""
    height_px = width_px // 2
    directions = latlong_directions(height_px, width_px).numpy()
    return Grid(directions, latlong_solid_angles(height_px, width_px).double().numpy())


def toward(azimuth_deg: float, elevation_deg: float) -> np.ndarray:
    """Unit direction [3] at an azimuth and elevation (convention: `light/sphere.py`)."""
    az, el = np.radians([azimuth_deg, elevation_deg])
    return np.array([np.cos(el) * np.sin(az), np.sin(el), np.cos(el) * np.cos(az)], np.float32)


def disc(grid: Grid, centre: np.ndarray, radius_deg: float) -> np.ndarray:
    """Compute the coverage [H, W] of a round light; it sums to the solid angle of the disc at any map size.

    A disc smaller than a pixel spreads over the nearest pixels, so that it never falls between their centres.
    """
    radius = np.radians(radius_deg)
    chord = np.linalg.norm(grid.directions - centre, axis=-1)
    angle = 2 * np.arcsin(np.clip(chord / 2, 0, 1))  # acos would round small angles to 0
    soft = np.clip(1 + (radius - angle) / grid.pixel_rad, 0, 1)
    exact_sr = 2 * np.pi * (1 - np.cos(radius))
    return np.asarray(soft * (exact_sr / (soft * grid.solid_angles_sr).sum()))


@dataclass(frozen=True)
class Rectangle:
    """Flat rectangle at distance 1 that faces the viewer, of half width `wide` and half height `high`."""

    azimuth_deg: float
    elevation_deg: float
    wide: float
    high: float

    @property
    def centre(self) -> np.ndarray:
        """Direction of the centre [3]."""
        return toward(self.azimuth_deg, self.elevation_deg)

    def place(self, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Project directions [..., 3]: position right and up, in half sizes, and a mask of those in front."""
        ahead, right = self.centre, toward(self.azimuth_deg + 90, 0)
        depth = directions @ ahead
        safe = np.maximum(depth, 1e-3)
        across = directions @ right / (safe * self.wide)
        return across, directions @ np.cross(ahead, right) / (safe * self.high), depth > 0.05

    def cover(self, directions: np.ndarray, edge: float) -> np.ndarray:
        """Compute the coverage [...] at directions [..., 3], with borders `edge` radians wide."""
        x, y, ahead = self.place(directions)
        across = np.clip((1 - np.abs(x)) * (self.wide / edge) + 0.5, 0, 1)
        along = np.clip((1 - np.abs(y)) * (self.high / edge) + 0.5, 0, 1)
        return np.asarray(across * along * ahead)


def paint(amount: np.ndarray, rgb: np.ndarray | Sequence[float]) -> np.ndarray:
    """Multiply an amount [H, W] by a colour [3]."""
    return amount[..., None] * np.asarray(rgb)


def draw_white(random: Random, cold: float = 0.0, warm: float = 1.0) -> np.ndarray:
    """Draw the white of a light [3], with green 1, from bluish daylight (0) to tungsten (1)."""
    share = random.uniform(cold, warm)
    return np.array([0.9 + 0.8 * share, 1.0, 1.15 - 0.8 * share])


def irradiance(grid: Grid, radiance: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """Compute irradiance [..., 3] on normals [..., 3], from first-order spherical harmonics of a map."""
    power = radiance * grid.solid_angles_sr[..., None]
    mean, slope = power.sum((0, 1)) / 4, np.einsum("hwd,hwc->dc", grid.directions, power) / 2
    return np.asarray(np.clip(mean + normals @ slope, 0, None))


def noise_tile(random: Random, slope: float = 1.7, coarsest: float = 3.0) -> np.ndarray:
    """Draw fractal noise [256, 256] float32 that tiles, of mean 0 and standard deviation 1.

    The amplitude is the frequency to the power -slope above `coarsest` periods per tile, and constant below.
    """
    rows, columns = np.fft.fftfreq(_TILE_PX)[:, None], np.fft.rfftfreq(_TILE_PX)
    frequency = np.hypot(rows, columns) * _TILE_PX
    shape = np.where(frequency > 0, np.maximum(frequency, coarsest) ** -slope, 0)
    spectrum = np.fft.rfft2(random.standard_normal((_TILE_PX, _TILE_PX))) * shape
    tile = np.fft.irfft2(spectrum, s=(_TILE_PX, _TILE_PX))
    return np.asarray(tile / tile.std(), np.float32)


def sample_tile(tile: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Sample a tile at positions [...], in tiles; bilinear and periodic."""
    size = len(tile)
    return np.asarray(map_coordinates(tile, [y * size, x * size], order=1, mode="grid-wrap"))


def ring_noise(random: Random, slope: float, coarsest: int = 1, finest: int = 400) -> np.ndarray:
    """Draw periodic fractal noise over the azimuth [RING], of mean 0 and standard deviation 1."""
    frequency = np.arange(RING // 2 + 1.0)
    shape = np.where((frequency >= coarsest) & (frequency <= finest), np.maximum(frequency, 1) ** -slope, 0)
    ring = np.fft.irfft(shape * np.exp(2j * np.pi * random.random(RING // 2 + 1)), n=RING)
    return np.asarray(ring / ring.std())


def sample_ring(grid: Grid, ring: np.ndarray) -> np.ndarray:
    """Sample a function of azimuth [RING] or [RING, C] at the columns of the map."""
    place = (grid.azimuths_rad / (2 * np.pi) % 1) * len(ring)
    low = np.floor(place).astype(int)
    share = (place - low).reshape(-1, *[1] * (ring.ndim - 1))
    return np.asarray(ring[low % len(ring)] * (1 - share) + ring[(low + 1) % len(ring)] * share)
