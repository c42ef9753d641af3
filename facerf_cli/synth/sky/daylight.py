"""Clear sky and sun after Preetham, Shirley and Smits, 'A Practical Analytic Model for Daylight' (1999).

The sky is the paper's appendix A.2 (Perez' distribution and the zenith's values). The sun is its appendix A.1
with the data of its table 2: what is above the atmosphere, less Rayleigh, aerosol and ozone extinction. Mixed
gases and water vapour, which absorb beyond 690 nm alone, are left out.

What procedural maps are painted with: the grid of a map, discs, rectangles and noise that no grid shapes.

Lat-long [H, 2 H, 3], scene-linear Rec.709. Conventions of directions: `light/sphere.py`. Scenes are functions
of direction, so that a map's size changes its resolution and not what it shows.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from scipy.ndimage import map_coordinates

from facerf_cli.light.sphere import latlong_directions, latlong_solid_angles

# Appendix A.2: Perez coefficients A..E of Y, x, y as slope and offset in turbidity.
_PEREZ = np.array(
    [
        [[0.1787, -1.4630], [-0.3554, 0.4275], [-0.0227, 5.3251], [0.1206, -2.5771], [-0.0670, 0.3703]],
        [[-0.0193, -0.2592], [-0.0665, 0.0008], [-0.0004, 0.2125], [-0.0641, -0.8989], [-0.0033, 0.0452]],
        [[-0.0167, -0.2608], [-0.0950, 0.0092], [-0.0079, 0.2102], [-0.0441, -1.6537], [-0.0109, 0.0529]],
    ]
)
# Appendix A.2: zenith chromaticity x, y; rows T^2, T, 1; columns theta^3, theta^2, theta, 1.
_ZENITH = np.array(
    [
        [
            [0.00166, -0.00375, 0.00209, 0],
            [-0.02903, 0.06377, -0.03202, 0.00394],
            [0.11693, -0.21196, 0.06052, 0.25886],
        ],
        [
            [0.00275, -0.00610, 0.00317, 0],
            [-0.04214, 0.08970, -0.04153, 0.00516],
            [0.15346, -0.26756, 0.06670, 0.26688],
        ],
    ]
)
_XYZ_TO_REC709 = np.array(
    [
        [3.2404542, -1.5371385, -0.4985314],
        [-0.969266, 1.8760108, 0.041556],
        [0.0556434, -0.2040259, 1.0572252],
    ]
)
SUN_RADIUS_DEG = 0.2665
SUN_SR = 2 * np.pi * (1 - np.cos(np.radians(SUN_RADIUS_DEG)))
_SUN_NM = np.arange(380, 751, 10.0)
# Table 2: the sun's radiance above the atmosphere, W / (cm2 um sr), over _SUN_NM.
# fmt: off
_SUN = 10 * np.array([
    165.5, 162.3, 211.2, 258.8, 258.2, 242.3, 267.6, 296.6, 305.4, 300.6, 306.6, 288.3, 287.1, 278.2,
    271.0, 272.3, 263.6, 255.0, 250.6, 253.1, 253.5, 251.3, 246.3, 241.7, 236.8, 232.1, 228.2, 223.4,
    219.7, 215.3, 211.0, 207.3, 202.4, 198.7, 194.3, 190.7, 186.3, 182.6,
])
# Table 2: ozone's absorption, 1 / cm, over _SUN_NM.
_OZONE = np.array([
    0, 0, 0, 0, 0, 0, 0, 0.003, 0.006, 0.009, 0.014, 0.021, 0.030, 0.040, 0.048, 0.063, 0.075, 0.085,
    0.103, 0.120, 0.120, 0.115, 0.125, 0.120, 0.105, 0.090, 0.079, 0.067, 0.057, 0.048, 0.036, 0.028,
    0.023, 0.018, 0.014, 0.011, 0.010, 0.009,
])
# fmt: on
_OZONE_CM = 0.35
_LUMENS_PER_WATT = 683.0


def preetham_sky(directions: np.ndarray, sun: np.ndarray, turbidity: float) -> np.ndarray:
    """Sky radiance [H, W, 3] linear Rec.709 (kcd/m2), without the sun's disc; the horizon's below it."""
    xyz = sky_xyz(directions, sun, turbidity)
    return np.asarray(np.clip(xyz @ _XYZ_TO_REC709.T.astype(xyz.dtype), 0, None))


def sky_xyz(directions: np.ndarray, sun: np.ndarray, turbidity: float) -> np.ndarray:
    """Sky radiance [..., 3] as CIE XYZ, Y in kcd/m2, along directions [..., 3]."""
    cos_theta = np.clip(directions[..., 1], 0.01, 1)  # B / cos diverges at the horizon
    cos_gamma = np.clip(directions @ sun, -1, 1)
    sun_theta = np.arccos(np.clip(sun[1], 0, 1))
    chi = (4 / 9 - turbidity / 120) * (np.pi - 2 * sun_theta)
    zenith_y = max((4.0453 * turbidity - 4.9710) * np.tan(chi) - 0.2155 * turbidity + 2.4192, 0.1)
    powers_t, powers_theta = turbidity ** np.array([2, 1, 0]), sun_theta ** np.array([3, 2, 1, 0])
    zenith = np.array([zenith_y, *(powers_t @ _ZENITH @ powers_theta)])
    values = []
    gamma = np.arccos(cos_gamma)
    for level, slopes in zip(zenith, _PEREZ, strict=True):
        perez = [float(value) for value in slopes @ [turbidity, 1.0]]
        at_zenith = _perez(perez, 1.0, float(sun_theta), float(np.cos(sun_theta)))
        values.append(_perez(perez, cos_theta, gamma, cos_gamma) * float(level / at_zenith))
    luminance, x, y = values
    return np.stack([x / y, np.ones_like(x), (1 - x - y) / y], -1) * luminance[..., None]


def _perez(
    c: list[float],
    cos_theta: np.ndarray | float,
    gamma: np.ndarray | float,
    cos_gamma: np.ndarray | float,
) -> np.ndarray:
    """Perez' distribution, equation 3 of the paper."""
    haze = 1 + c[2] * np.exp(c[3] * gamma) + c[4] * cos_gamma**2
    return np.asarray((1 + c[0] * np.exp(c[1] / cos_theta)) * haze)


def sun_irradiance(elevation_deg: float, turbidity: float) -> np.ndarray:
    """Irradiance [3] across the sun's beam, linear Rec.709 (klx); its luminance is the illuminance."""
    xyz = _sun_to_xyz() @ (transmittance(_SUN_NM, elevation_deg, turbidity) * _SUN)
    return np.asarray(np.clip(_XYZ_TO_REC709 @ xyz, 0, None))


def transmittance(wavelength_nm: np.ndarray, elevation_deg: float, turbidity: float) -> np.ndarray:
    """Share of the sun's light [W] that comes down: appendix A.1, Rayleigh, aerosol and ozone extinction."""
    theta_deg, um = 90 - elevation_deg, wavelength_nm / 1000
    air_mass = 1 / (np.cos(np.radians(theta_deg)) + 0.15 * (93.885 - theta_deg) ** -1.253)
    beta = 0.04608365822050 * turbidity - 0.04586025928522  # Angstrom's turbidity
    ozone = np.interp(wavelength_nm, _SUN_NM, _OZONE) * _OZONE_CM
    return np.asarray(np.exp(-air_mass * (0.008735 * um**-4.08 + beta * um**-1.3 + ozone)))


@lru_cache(maxsize=1)
def _sun_to_xyz() -> np.ndarray:
    """From spectral radiance of the sun's disc (table 2) to XYZ irradiance in klx: [3, W]."""
    per_nm = SUN_SR * 10.0  # W / (cm2 um sr) over the disc, in W / (m2 nm)
    step_nm = _SUN_NM[1] - _SUN_NM[0]
    return np.asarray(_LUMENS_PER_WATT / 1000 * per_nm * step_nm * _colour_matching(_SUN_NM))


def _colour_matching(wavelength_nm: np.ndarray) -> np.ndarray:
    """CIE 1931 colour matching functions [3, W].

    The multi-lobe fit of Wyman, Sloan and Shirley, 'Simple Analytic Approximations to the CIE XYZ Color
    Matching Functions', JCGT 2(2), 2013.
    """
    x = _lobe(wavelength_nm, 1.056, 599.8, 37.9, 31.0) + _lobe(wavelength_nm, 0.362, 442.0, 16.0, 26.7)
    x = x + _lobe(wavelength_nm, -0.065, 501.1, 20.4, 26.2)
    y = _lobe(wavelength_nm, 0.821, 568.8, 46.9, 40.5) + _lobe(wavelength_nm, 0.286, 530.9, 16.3, 31.1)
    z = _lobe(wavelength_nm, 1.217, 437.0, 11.8, 36.0) + _lobe(wavelength_nm, 0.681, 459.0, 26.0, 13.8)
    return np.stack([x, y, z])


def _lobe(nm: np.ndarray, height: float, middle: float, left: float, right: float) -> np.ndarray:
    return np.asarray(height * np.exp(-0.5 * ((nm - middle) / np.where(nm < middle, left, right)) ** 2))


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
