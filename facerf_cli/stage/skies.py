"""Procedural environment maps: lat-long [H, 2 H, 3], scene-linear Rec.709, seeded; a kind a function.

Suns shine through the daylight model of Preetham, Shirley and Smits, 'A Practical Analytic Model for
Daylight' (SIGGRAPH 1999); overcast skies are the CIE's standard (Moon and Spencer). The other kinds are
lamps, windows and walls with plausible albedo. Conventions of directions: `light/sphere.py`.
"""

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from facerf_cli.errors import UsageError
from facerf_cli.light.sphere import latlong_directions, latlong_solid_angles
from facerf_cli.stage.daylight import preetham_sky, sun_irradiance

Random = np.random.Generator
SUN_RADIUS_DEG = 0.2665
_PEAK = 60000.0  # what half floats hold, with room


@dataclass(frozen=True)
class Grid:
    """The pixels of a map of some size."""

    directions: np.ndarray  # [H, W, 3] float32
    solid_angles_sr: np.ndarray  # [H, W] float64

    @property
    def pixel_rad(self) -> float:
        """Height of a pixel."""
        return np.pi / len(self.directions)


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


def paint(amount: np.ndarray, rgb: np.ndarray | Sequence[float]) -> np.ndarray:
    """Light of one colour [H, W, 3] where amount [H, W] is."""
    return amount[..., None] * np.asarray(rgb)


def _warmth(random: Random, cold: float = 0.0, warm: float = 1.0) -> np.ndarray:
    """A lamp's white [3], green 1: from bluish daylight (0) to tungsten (1)."""
    share = random.uniform(cold, warm)
    return np.array([0.9 + 0.8 * share, 1.0, 1.15 - 0.8 * share])


def _ground(grid: Grid, sky: np.ndarray, albedo: np.ndarray, direct: np.ndarray | float = 0.0) -> np.ndarray:
    """The sky above, and below a Lambertian ground that it lights (`direct`: the sun's share [3])."""
    height = grid.directions[..., 1:2]
    share = np.clip(height / grid.pixel_rad + 0.5, 0, 1)
    cosine_sr = (np.clip(height, 0, None)[..., 0] * grid.solid_angles_sr)[..., None]
    irradiance = (sky * cosine_sr).sum((0, 1)) + direct
    return np.asarray(share * sky + (1 - share) * albedo * irradiance / np.pi)


def _albedo(random: Random) -> np.ndarray:
    """Asphalt, sand, grass or snow-free earth [3]."""
    kinds = ([0.12, 0.12, 0.12], [0.38, 0.31, 0.22], [0.07, 0.11, 0.04], [0.22, 0.17, 0.12])
    return np.array(kinds[random.integers(4)]) * random.uniform(0.8, 1.25)


def sun(grid: Grid, random: Random) -> np.ndarray:
    """A clear to hazy day: the sun from 2 to 75 degrees high, the sky around it, the ground below."""
    turbidity = random.uniform(2.2, 8)
    elevation_deg = float(random.choice([random.uniform(2, 20), random.uniform(15, 75)]))
    centre = toward(random.uniform(-180, 180), elevation_deg)
    sky = preetham_sky(grid.directions, centre, turbidity)
    veil = random.choice([1.0, np.exp(-random.uniform(0, 4))])  # thin cloud before the sun
    beam = veil * sun_irradiance(elevation_deg, turbidity)
    radius_sr = 2 * np.pi * (1 - np.cos(np.radians(SUN_RADIUS_DEG)))
    lit = _ground(grid, sky, _albedo(random), beam * centre[1])
    return np.asarray(lit + paint(disc(grid, centre, SUN_RADIUS_DEG), beam / radius_sr))


def overcast(grid: Grid, random: Random) -> np.ndarray:
    """CIE standard overcast sky, (1 + 2 sin el) / 3, a little brighter on the sun's side."""
    height = np.clip(grid.directions[..., 1], 0, 1)
    hint = random.uniform(0, 1.5) * (0.5 + 0.5 * grid.directions @ toward(random.uniform(-180, 180), 40)) ** 4
    tint = np.array([0.94, 1.0, 1.08]) ** random.uniform(0, 1.5)
    return _ground(grid, paint((1 + 2 * height) / 3 * (1 + hint), tint), _albedo(random))


def _rectangle(grid: Grid, azimuth_deg: float, elevation_deg: float, wide: float, high: float) -> np.ndarray:
    """Coverage [H, W] of a flat rectangle of half sizes `wide` and `high` at distance 1, facing us."""
    ahead, right = toward(azimuth_deg, elevation_deg), toward(azimuth_deg + 90, 0)
    depth = grid.directions @ ahead
    safe = np.maximum(depth, 1e-3)
    x, y = grid.directions @ right / safe, grid.directions @ np.cross(ahead, right) / safe
    edge = grid.pixel_rad
    across = np.clip((wide - np.abs(x)) / edge + 0.5, 0, 1)
    along = np.clip((high - np.abs(y)) / edge + 0.5, 0, 1)
    return np.asarray(across * along * (depth > 0.05))


def _room(grid: Grid, lights: np.ndarray, random: Random, wall: tuple[float, float]) -> np.ndarray:
    """Walls, floor and ceiling [H, W, 3] of a box, lit by the lights' mean and more where these are near."""
    half = np.array([random.uniform(1.5, 5), random.uniform(1.2, 2), random.uniform(1.5, 5)])
    turned = grid.directions @ _turn(random.uniform(0, 90))
    distances = half / np.maximum(np.abs(turned), 1e-6)
    side = distances.argmin(-1)
    grey = np.exp(random.uniform(*np.log(wall)))
    wall_rgb = grey * np.array([1.0, 0.96, 0.9]) ** random.uniform(0, 2)
    floor_rgb = grey * random.uniform(0.3, 1) * np.array([1.0, 0.85, 0.7]) ** random.uniform(0, 2)
    albedo = np.where((side == 1)[..., None], np.where(turned[..., 1:2] < 0, floor_rgb, wall_rgb), wall_rgb)
    power = lights * grid.solid_angles_sr[..., None]
    mean = (power.sum(-1)[..., None] * grid.directions).sum((0, 1))
    nearness = 1 + 0.7 * grid.directions @ (mean / max(np.linalg.norm(mean), 1e-9))
    corner = np.sort(distances, -1)
    occlusion = 0.6 + 0.4 * np.clip((corner[..., 1] - corner[..., 0]) / corner[..., 0], 0, 1)
    level = power.sum((0, 1)) / (4 * np.pi)
    return np.asarray(albedo * level * (nearness * occlusion)[..., None] / (1 - grey))


def _turn(angle_deg: float) -> np.ndarray:
    c, s = np.cos(np.radians(angle_deg)), np.sin(np.radians(angle_deg))
    return np.array([[c, 0, -s], [0, 1, 0], [s, 0, c]])


def windows(grid: Grid, random: Random) -> np.ndarray:
    """One to four daylit windows along a wall of a room, at times with a warm lamp."""
    azimuth_deg, lights = random.uniform(-180, 180), np.zeros((*grid.directions.shape[:2], 3))
    wide, high = random.uniform(0.12, 0.4), random.uniform(0.25, 0.7)
    day = _warmth(random, 0, 0.3) * random.uniform(5, 40)
    for index in range(random.integers(1, 5)):
        pane = _rectangle(grid, azimuth_deg + 65 * index, random.uniform(0, 10), wide, high)
        view = np.where(grid.directions[..., 1] > 0, 1.0, 0.35)
        lights += paint(pane * view, day)
    if random.random() < 0.5:
        lamp = disc(grid, toward(random.uniform(-180, 180), random.uniform(10, 70)), random.uniform(1.5, 5))
        lights += paint(lamp, _warmth(random, 0.7, 1) * random.uniform(20, 300))
    return lights + _room(grid, lights, random, (0.35, 0.75))


def studio(grid: Grid, random: Random) -> np.ndarray:
    """One to four softboxes and bare lamps in a room with dark to white walls."""
    lights = np.zeros((*grid.directions.shape[:2], 3))
    for _ in range(random.integers(1, 5)):
        at, level = (random.uniform(-180, 180), random.uniform(-10, 60)), np.exp(random.uniform(2, 6))
        box = _rectangle(grid, *at, random.uniform(0.1, 0.6), random.uniform(0.15, 0.7))
        lights += paint(box, _warmth(random, 0.1, 0.5) * level)
    for _ in range(random.integers(0, 3)):
        lamp = disc(grid, toward(random.uniform(-180, 180), random.uniform(0, 70)), random.uniform(0.5, 3))
        lights += paint(lamp, _warmth(random, 0.2, 0.9) * np.exp(random.uniform(5, 9)))
    return lights + _room(grid, lights, random, (0.001, 0.6))


def night(grid: Grid, random: Random) -> np.ndarray:
    """A street: lamps of one kind in a row and lit windows, over asphalt, under a dim sky."""
    glow = random.uniform(0.005, 0.05)
    sky = paint(glow * (1.5 - np.clip(grid.directions[..., 1], 0, 1)), [0.9, 0.75, 0.8])
    lamp_rgb = np.array([[1.7, 1.0, 0.25], [1.3, 1.0, 0.6], [0.95, 1.0, 1.05]][random.integers(3)])
    road_deg, direct = random.uniform(-180, 180), np.zeros(3)
    lights = np.zeros_like(sky)
    for _ in range(random.integers(3, 12)):
        along_m, aside_m = random.uniform(-40, 40), random.choice([-5, 5])
        distance_m = np.hypot(np.hypot(along_m, aside_m), 5)
        azimuth_deg = road_deg + np.degrees(np.arctan2(aside_m, along_m))
        centre = toward(azimuth_deg, np.degrees(np.arcsin(5 / distance_m)))
        radiance = lamp_rgb * random.uniform(1000, 4000)
        radius_deg = float(np.degrees(0.2 / distance_m))
        lights += paint(disc(grid, centre, radius_deg), radiance)
        direct += radiance * np.pi * (0.2 / distance_m) ** 2 * centre[1]
    for _ in range(random.integers(0, 25)):
        at = random.uniform(-180, 180), random.uniform(2, 30)
        lights += paint(_rectangle(grid, *at, 0.02, 0.03), _warmth(random, 0.3, 1) * random.uniform(1, 10))
    return _ground(grid, sky, _albedo(random), direct) + lights


def stage(grid: Grid, random: Random) -> np.ndarray:
    """Two to six strongly coloured lamps in a nearly black hall."""
    lights = np.zeros((*grid.directions.shape[:2], 3))
    for _ in range(random.integers(2, 7)):
        rgb = 0.05 + random.dirichlet([0.5, 0.5, 0.5])
        lamp = disc(grid, toward(random.uniform(-180, 180), random.uniform(-10, 75)), random.uniform(1, 10))
        lights += paint(lamp, rgb * np.exp(random.uniform(3, 6)))
    return lights + _room(grid, lights, random, (0.005, 0.25))


KINDS: dict[str, Callable[[Grid, Random], np.ndarray]] = {
    kind.__name__: kind for kind in (sun, overcast, windows, studio, night, stage)
}


def kind_of(index: int, seed: int, kinds: Sequence[str] = tuple(KINDS)) -> str:
    """The kind of the map with this index: a function of (seed, index) and nothing else."""
    return kinds[int(np.random.default_rng([seed, index, 0]).integers(len(kinds)))]


def draw_sky(
    index: int, seed: int, width_px: int, kinds: Sequence[str] = tuple(KINDS)
) -> tuple[np.ndarray, str]:
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
