"""Kinds of procedural envmaps outdoors: sun, dusk, overcast, night, with their clouds and land.

Units differ by kind (kcd/m2 by day, relative ones otherwise); `skies.py` normalises the finished map.

Clear sky and sun follow Preetham, Shirley and Smits, 'A Practical Analytic Model for Daylight' (1999).
The sky is appendix A.2: Perez's distribution, and the luminance and chromaticity of the zenith. The sun is
appendix A.1 with the spectra of table 2: the radiance above the atmosphere, reduced by Rayleigh, aerosol and
ozone extinction. Mixed gases and water vapour are left out, as they absorb only beyond 690 nm.
"""

from dataclasses import dataclass, replace

import numpy as np

from facerf_cli.synth import tables_of
from facerf_cli.synth.random_fields import Random
from facerf_cli.synth.sky.painting import (
    RING,
    Grid,
    Rectangle,
    disc,
    draw_white,
    irradiance,
    noise_tile,
    paint,
    ring_noise,
    sample_ring,
    sample_tile,
    toward,
)

_TABLES = {name: np.array(values, float) for name, values in tables_of(__file__).items()}
_XYZ_TO_REC709, _GROUNDS = _TABLES["xyz_to_rec709"], _TABLES["grounds"]
SUN_RADIUS_DEG = 0.2665  # angular radius of the disc
SUN_SR = 2 * np.pi * (1 - np.cos(np.radians(SUN_RADIUS_DEG)))  # its solid angle
_SUN_NM = np.arange(380, 751, 10.0)  # wavelengths of the spectra of sun and ozone
_SUN = 10 * _TABLES["sun"]
_OZONE_CM = 0.35  # thickness of the ozone layer (appendix A.1)
_LUMENS_PER_WATT = 683.0  # at the peak of photopic vision
EYE_M = 1.6  # height of the head above the ground
_EARTH_KM = 6371.0  # radius
_SHARPNESS = 0.78  # g of Henyey and Greenstein's phase function, lowered to stand for multiple scattering
_LAMP_M = 0.2  # radius of a street light
_NO_BEAM, _UP = np.zeros(3), np.array([0.0, 1.0, 0.0], np.float32)


def preetham_sky(directions: np.ndarray, sun: np.ndarray, turbidity: float) -> np.ndarray:
    """Compute sky radiance [H, W, 3], linear Rec.709 (kcd/m2), without the disc of the sun.

    Directions below the horizon get the radiance of the horizon.
    """
    xyz = sky_xyz(directions, sun, turbidity)
    return np.asarray(np.clip(xyz @ _XYZ_TO_REC709.T.astype(xyz.dtype), 0, None))


def sky_xyz(directions: np.ndarray, sun: np.ndarray, turbidity: float) -> np.ndarray:
    """Compute sky radiance [..., 3] as CIE XYZ, Y in kcd/m2, along directions [..., 3]."""
    cos_theta = np.clip(directions[..., 1], 0.01, 1)  # B / cos(theta) diverges at the horizon
    cos_gamma = np.clip(directions @ sun, -1, 1)
    sun_theta = np.arccos(np.clip(sun[1], 0, 1))
    chi = (4 / 9 - turbidity / 120) * (np.pi - 2 * sun_theta)
    zenith_y = max((4.0453 * turbidity - 4.9710) * np.tan(chi) - 0.2155 * turbidity + 2.4192, 0.1)
    powers_t, powers_theta = turbidity ** np.array([2, 1, 0]), sun_theta ** np.array([3, 2, 1, 0])
    zenith = np.array([zenith_y, *(powers_t @ _TABLES["zenith"] @ powers_theta)])
    values = []
    gamma = np.arccos(cos_gamma)
    for level, slopes in zip(zenith, _TABLES["perez"], strict=True):
        perez = [float(value) for value in slopes @ [turbidity, 1.0]]
        at_zenith = _perez(perez, 1.0, float(sun_theta), float(np.cos(sun_theta)))
        values.append(_perez(perez, cos_theta, gamma, cos_gamma) * float(level / at_zenith))
    luminance, x, y = values
    return np.stack([x / y, np.ones_like(x), (1 - x - y) / y], -1) * luminance[..., None]


def _perez(
    c: list[float], cos_theta: np.ndarray | float, gamma: np.ndarray | float, cos_gamma: np.ndarray | float
) -> np.ndarray:
    """Perez's distribution, equation 3 of the paper."""
    haze = 1 + c[2] * np.exp(c[3] * gamma) + c[4] * cos_gamma**2
    return np.asarray((1 + c[0] * np.exp(c[1] / cos_theta)) * haze)


def sun_irradiance(elevation_deg: float, turbidity: float) -> np.ndarray:
    """Compute the irradiance [3] on a plane across the sunlight, linear Rec.709 (klx)."""
    xyz = _sun_to_xyz() @ (transmittance(_SUN_NM, elevation_deg, turbidity) * _SUN)
    return np.asarray(np.clip(_XYZ_TO_REC709 @ xyz, 0, None))


def transmittance(wavelength_nm: np.ndarray, elevation_deg: float, turbidity: float) -> np.ndarray:
    """Compute the share of sunlight [W] that reaches the ground at each wavelength [W] (appendix A.1)."""
    theta_deg, um = 90 - elevation_deg, wavelength_nm / 1000
    air_mass = 1 / (np.cos(np.radians(theta_deg)) + 0.15 * (93.885 - theta_deg) ** -1.253)
    beta = 0.04608365822050 * turbidity - 0.04586025928522  # Angstrom's turbidity coefficient
    ozone = np.interp(wavelength_nm, _SUN_NM, _TABLES["ozone"]) * _OZONE_CM
    return np.asarray(np.exp(-air_mass * (0.008735 * um**-4.08 + beta * um**-1.3 + ozone)))


def _sun_to_xyz() -> np.ndarray:
    """Return the matrix [3, W] from the sun's spectral radiance (table 2) to its XYZ irradiance in klx."""
    per_nm = SUN_SR * 10.0  # from W / (cm2 um sr) over the disc to W / (m2 nm)
    step_nm = _SUN_NM[1] - _SUN_NM[0]
    return np.asarray(_LUMENS_PER_WATT / 1000 * per_nm * step_nm * _colour_matching(_SUN_NM))


def _colour_matching(wavelength_nm: np.ndarray) -> np.ndarray:
    """CIE 1931 colour matching functions [3, W] at wavelengths [W].

    They are the multi-lobe fit of Wyman, Sloan and Shirley, 'Simple Analytic Approximations to the CIE XYZ
    Color Matching Functions', JCGT 2(2), 2013.
    """
    x = _lobe(wavelength_nm, 1.056, 599.8, 37.9, 31.0) + _lobe(wavelength_nm, 0.362, 442.0, 16.0, 26.7)
    x = x + _lobe(wavelength_nm, -0.065, 501.1, 20.4, 26.2)
    y = _lobe(wavelength_nm, 0.821, 568.8, 46.9, 40.5) + _lobe(wavelength_nm, 0.286, 530.9, 16.3, 31.1)
    z = _lobe(wavelength_nm, 1.217, 437.0, 11.8, 36.0) + _lobe(wavelength_nm, 0.681, 459.0, 26.0, 13.8)
    return np.stack([x, y, z])


def _lobe(nm: np.ndarray, height: float, middle: float, left: float, right: float) -> np.ndarray:
    return np.asarray(height * np.exp(-0.5 * ((nm - middle) / np.where(nm < middle, left, right)) ** 2))


@dataclass(frozen=True)
class Skyline:
    """Silhouette on the horizon: its upper edge and albedo at every azimuth."""

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
    above = grid.share(grid.directions[..., 1:2])
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
    """Return the radiance [H, W, 3] of the ground, black above; `level` is the radiance if it were white."""
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
    share = grid.share(tops - elevation)
    share = share * grid.share(elevation) * (tops > 0)
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


@dataclass(frozen=True)
class Layer:
    """Sheet of cloud at one height, with optical depth from noise."""

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
    """Draw a street at night: a row of street lights, lit windows, paving and houses under a dim sky."""
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
    fronts = 0.15 * beam  # light on houses, if all street lights stood at the viewer
    lit = paint(pools, lamp_rgb) + 0.03 * beam  # the second term stands for lights farther away
    return add_land(grid, sky, land, _UP, _NO_BEAM, fronts, lit) + lights


def _street_lamps(random: Random) -> tuple[np.ndarray, np.ndarray]:
    """Draw positions [L, 3] (m, from the head) of street lights along a road, and their colour [3]."""
    lamp_rgb = np.array([[1.7, 1.0, 0.25], [1.3, 1.0, 0.6], [0.95, 1.0, 1.05]][random.integers(3)])
    lamps, road = random.integers(3, 12), toward(random.uniform(-180, 180), 0).astype(float)
    along_m, aside_m = random.uniform(-40, 40, lamps)[:, None], random.choice([-5, 5], lamps)[:, None]
    up = np.array([0, random.uniform(2.5, 6), 0])
    return along_m * road + aside_m * np.array([road[2], 0, -road[0]]) + up, lamp_rgb


def _pool(grid: Grid, place_m: np.ndarray) -> np.ndarray:
    """Return the irradiance [H, W] on the ground from a street light of radiance 1."""
    down = np.minimum(grid.directions[..., 1:2], -0.003)
    away = place_m - grid.directions * (EYE_M / -down)
    square = (away * away).sum(-1)
    share = grid.share(-grid.directions[..., 1])
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
