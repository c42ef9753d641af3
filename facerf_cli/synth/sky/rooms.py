"""A furnished room, lit by its lights, for the procedural envmaps indoors.

A room is a box. Its lights illuminate it by distance and angle; interreflection adds an even light.
"""

from dataclasses import dataclass, field

import numpy as np

from facerf_cli.synth.sky.painting import RING, Grid, Random, noise_tile, sample_ring, sample_tile

_CLOSEST_M = 0.5  # least distance to a light: lights have an extent, so 1 / r^2 has a limit
# Linear RGB of floors: three of wood, two of stone.
_FLOORS = np.array(
    [[0.35, 0.2, 0.1], [0.5, 0.34, 0.2], [0.16, 0.09, 0.05], [0.25, 0.25, 0.26], [0.5, 0.48, 0.45]]
)


@dataclass(frozen=True)
class Box:
    """A room around the head, in metres, rotated about the vertical."""

    low: np.ndarray  # [3] lower back corner
    high: np.ndarray  # [3] opposite corner
    turn: np.ndarray  # [3, 3] map axes to box axes

    def hits(self, origins: np.ndarray, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Intersect rays [..., 3] in box axes with the walls: distance [...] and axis [...] of the wall."""
        safe = np.where(np.abs(directions) < 1e-6, 1e-6, directions)
        distances = (np.where(safe > 0, self.high, self.low) - origins) / safe
        return distances.min(-1), distances.argmin(-1)


@dataclass
class Lights:
    """Light sources of a room: their image in the map, and the direction and power of each."""

    grid: Grid
    image: np.ndarray = field(init=False)  # [H, W, 3]
    sources: list[tuple[np.ndarray, np.ndarray, bool]] = field(default_factory=list)  # centre, power, flat

    def __post_init__(self) -> None:
        self.image = np.zeros(self.grid.directions.shape)

    def add(self, centre: np.ndarray, radiance: np.ndarray, flat: bool) -> None:
        """Add a source of radiance [H, W, 3] at a direction [3]; a flat one emits by the cosine."""
        self.image += radiance
        self.sources.append((centre, (radiance * self.grid.solid_angles_sr[..., None]).sum((0, 1)), flat))


@dataclass(frozen=True)
class Room:
    """A box, and the surface that each pixel of the map shows."""

    box: Box
    points: np.ndarray  # [H, W, 3] m, in the box's axes
    normals: np.ndarray  # [H, W, 3], inward
    albedo: np.ndarray  # [H, W, 3]
    crease: np.ndarray  # [H, W] share of the ambient light, from about 0.5 in corners to 1

    def lit(self, lights: Lights) -> np.ndarray:
        """Compute the radiance [H, W, 3] of the walls under lights."""
        direct = np.zeros(self.points.shape)
        for centre, power, flat in lights.sources:
            direct += self._irradiance(centre, flat)[..., None] * power
        share = (lights.grid.solid_angles_sr / (4 * np.pi))[..., None]
        grey = (self.albedo * share).sum((0, 1))
        even = (direct * self.albedo * share).sum((0, 1)) / (1 - np.minimum(grey, 0.85))
        return np.asarray(self.albedo / np.pi * (direct + even * self.crease[..., None]))

    def _irradiance(self, centre: np.ndarray, flat: bool) -> np.ndarray:
        """Irradiance [H, W] from a light whose radiance times solid angle, seen from the head, is 1."""
        ahead = (self.box.turn @ centre).astype(np.float32)
        distance_m = float(self.box.hits(np.zeros(3, np.float32), ahead)[0]) * 0.93
        away = self.points - distance_m * ahead
        square = np.maximum((away * away).sum(-1), _CLOSEST_M**2)
        length = np.sqrt(square)
        cosine = np.clip(-(away * self.normals).sum(-1) / length, 0, None)
        if flat:
            cosine = cosine * np.clip(-(away @ ahead) / length, 0, None)
        return np.asarray(cosine * distance_m**2 / square)


def draw_room(grid: Grid, random: Random, wall: tuple[float, float], largest_m: float = 5.0) -> Room:
    """Draw a furnished room; `wall` bounds the albedo of its walls."""
    wide, long = (np.exp(random.uniform(np.log(1.5), np.log(largest_m), 2)) for _ in range(2))
    eye, above = random.uniform(1.1, 1.7), random.uniform(0.9, 0.3 * largest_m + 0.7)
    angle = np.radians(random.uniform(0, 90))
    c, s = np.cos(angle), np.sin(angle)
    box = Box(
        np.array([-wide[0], -eye, -long[0]], np.float32),
        np.array([wide[1], above, long[1]], np.float32),
        np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]], np.float32),
    )
    directions = grid.directions @ box.turn.T
    distance, axis = box.hits(np.zeros(3, np.float32), directions)
    points = directions * distance[..., None]
    normals = -np.sign(directions) * (axis[..., None] == np.arange(3))
    albedo = _surfaces(grid, random, points, normals, wall, eye)
    gaps = np.sort(np.minimum(points - box.low, box.high - points), -1)[..., 1]
    return Room(box, points, normals.astype(np.float32), albedo, 1 - 0.45 * np.exp(-gaps / 0.35))


def _surfaces(
    grid: Grid, random: Random, points: np.ndarray, normals: np.ndarray, wall: tuple[float, float], eye: float
) -> np.ndarray:
    """Albedo [H, W, 3] of walls (one may be coloured), a bright ceiling, a floor and furniture."""
    grey = float(np.exp(random.uniform(*np.log(wall))))
    walls = grey * np.array([1.0, 0.96, 0.9]) ** random.uniform(0, 2)
    accent = np.clip(walls * np.exp(random.normal(0, 0.45, 3)), 0, 0.85) if random.random() < 0.4 else walls
    floor = np.minimum(_FLOORS[random.integers(len(_FLOORS))] * grey * random.uniform(0.9, 2.2), 0.75)
    ceiling = np.full(3, min(1.25 * grey, 0.85))
    albedo = np.where(normals[..., :1] > 0.5, accent, walls)
    albedo = np.where(normals[..., 1:2] < -0.5, ceiling, albedo)
    boards = np.exp(0.12 * sample_tile(noise_tile(random, 1.2, 2), points[..., 0] / 4, points[..., 2] / 0.7))
    albedo = np.where(normals[..., 1:2] > 0.5, floor * boards[..., None], albedo)
    stuff = grey * np.exp(random.normal(-0.8, 0.8, (24, 1)) + random.normal(0, 0.2, (24, 3)))
    stuff = np.clip(stuff, 0.002, 0.7)
    return _furnish(grid, random, points, albedo, stuff, eye)


def _furnish(
    grid: Grid, random: Random, points: np.ndarray, albedo: np.ndarray, stuff: np.ndarray, eye: float
) -> np.ndarray:
    """Add a band of furniture of varying height along the walls to the albedo [H, W, 3]."""
    edges = np.sort(random.uniform(0, RING, len(stuff)))
    index = np.searchsorted(edges, np.arange(RING)) % len(stuff)
    tall_m = np.where(random.random(len(stuff)) < 0.3, 0.0, random.choice([0.45, 0.75, 0.9, 1.9], len(stuff)))
    nearer = random.uniform(0.6, 0.85)  # distance of the furniture over that of the wall
    reach = np.hypot(points[..., 0], points[..., 2])
    tops = (sample_ring(grid, tall_m[index]) - eye) / nearer
    bottom = -eye / nearer
    slope = points[..., 1] / np.maximum(reach, 1e-3)  # tangent of the elevation
    ring_reach = np.median(reach[len(reach) // 2 - 1 : len(reach) // 2 + 1], axis=0)
    soft = grid.pixel_rad * 2
    share = np.clip((tops / ring_reach - slope) / soft + 0.5, 0, 1)
    share = share * np.clip((slope - bottom / ring_reach) / soft + 0.5, 0, 1)
    share = share * (sample_ring(grid, tall_m[index]) > 0)
    foot = np.clip((slope - bottom / ring_reach) / np.maximum((tops - bottom) / ring_reach, 1e-3), 0, 1)
    shaded = sample_ring(grid, stuff[index]) * (0.25 + 0.75 * np.sqrt(foot))[..., None]
    return np.asarray(albedo + share[..., None] * (shaded - albedo))
