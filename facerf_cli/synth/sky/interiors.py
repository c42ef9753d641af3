"""Kinds of procedural envmaps indoors: windows, hall, studio, stage; and the furnished room they show.

A room is a box. Its lights illuminate it by distance and angle; interreflection adds a uniform light.

The sky outside a window has a radiance of about 1 before exposure; `skies.py` normalises the finished map.
"""

from dataclasses import dataclass, field, replace

import numpy as np

from facerf_cli.synth.random_fields import Random
from facerf_cli.synth.sky.painting import (
    RING,
    Grid,
    Rectangle,
    disc,
    draw_white,
    noise_tile,
    paint,
    ring_noise,
    sample_ring,
    sample_tile,
    toward,
)

_CLOSEST_M = 0.5  # least distance to a light: lights have an extent, so 1 / r^2 has a limit
# Linear RGB of floors: three of wood, two of stone.
_FLOORS = np.array(
    [[0.35, 0.2, 0.1], [0.5, 0.34, 0.2], [0.16, 0.09, 0.05], [0.25, 0.25, 0.26], [0.5, 0.48, 0.45]]
)
_MAX_HALL_LIGHTS = 12  # ceiling lights that illuminate the room; the image shows all


@dataclass(frozen=True)
class Box:
    """Room around the head, in metres, rotated about the vertical."""

    low: np.ndarray  # [3] lower back corner
    high: np.ndarray  # [3] opposite corner
    turn: np.ndarray  # [3, 3] map axes to box axes

    def hits(self, origins: np.ndarray, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Intersect rays [..., 3] in box axes with the walls: distance [...] and axis [...] of the wall."""
        safe = np.where(np.abs(directions) < 1e-6, 1e-6, directions)
        distances = (np.where(safe > 0, self.high, self.low) - origins) / safe
        return distances.min(-1), distances.argmin(-1)


@dataclass
class RoomLights:
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
    """Box, and the surface that each pixel of the map shows."""

    box: Box
    points: np.ndarray  # [H, W, 3] m, in the box's axes
    normals: np.ndarray  # [H, W, 3], inward
    albedo: np.ndarray  # [H, W, 3]
    crease: np.ndarray  # [H, W] share of the ambient light, from about 0.5 in corners to 1

    def lit(self, lights: RoomLights) -> np.ndarray:
        """Compute the radiance [H, W, 3] of the walls under lights."""
        direct = np.zeros(self.points.shape)
        for centre, power, flat in lights.sources:
            direct += self._irradiance(centre, flat)[..., None] * power
        share = (lights.grid.solid_angles_sr / (4 * np.pi))[..., None]
        grey = (self.albedo * share).sum((0, 1))
        even = (direct * self.albedo * share).sum((0, 1)) / (1 - np.minimum(grey, 0.85))
        return np.asarray(self.albedo / np.pi * (direct + even * self.crease[..., None]))

    def _irradiance(self, centre: np.ndarray, flat: bool) -> np.ndarray:
        """Return the irradiance [H, W] from a light whose radiance times solid angle, at the head, is 1."""
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
    """Return the albedo [H, W, 3] of walls (one may be coloured), a bright ceiling, a floor and furniture."""
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


def windows(grid: Grid, random: Random) -> np.ndarray:
    """Draw a room with one to four windows on sky and land; some have direct sun or a ceiling light."""
    room, lights = draw_room(grid, random, (0.35, 0.75)), RoomLights(grid)
    azimuth_deg = random.uniform(-180, 180)
    wide, high = random.uniform(0.12, 0.45), random.uniform(0.25, 0.7)
    day = draw_white(random, 0, 0.3) * np.exp(random.uniform(1.2, 4))
    view = _outside(grid, random) * day
    panes = [
        Rectangle(azimuth_deg + random.uniform(50, 75) * index, random.uniform(0, 10), wide, high)
        for index in range(random.integers(1, 5))
    ]
    for pane in panes:
        lights.add(pane.centre, _pane(grid, pane)[..., None] * view, flat=True)
    if random.random() < 0.35:
        beam = np.array([1.1, 1.0, 0.8]) * day.mean() * random.uniform(2, 12)
        lights.image += _sunlit(grid, room, panes[0], random)[..., None] * room.albedo / np.pi * beam
    if random.random() < 0.5:
        centre = toward(random.uniform(-180, 180), random.uniform(10, 70))
        bulb = disc(grid, centre, random.uniform(1.5, 5))
        lights.add(
            centre, paint(bulb, draw_white(random, 0.6, 1) * np.exp(random.uniform(2.5, 5.5))), flat=False
        )
    opaque = np.prod([1 - _pane(grid, pane) for pane in panes], axis=0)
    return lights.image + room.lit(lights) * opaque[..., None]


def _outside(grid: Grid, random: Random) -> np.ndarray:
    """Draw the view through a window [H, W, 3]: land and a sky of radiance about 1."""
    elevation = grid.elevations_rad
    tops = np.radians(random.uniform(-2, 14)) * (
        0.6 + 0.3 * sample_ring(grid, ring_noise(random, 0.8, 2, 300))
    )
    land = np.array([0.12, 0.16, 0.07]) * random.uniform(0.5, 1.6)
    share = np.maximum(grid.share(tops - elevation), grid.share(-elevation))[..., None]
    sky = np.array([0.9, 1.0, 1.12]) * (1.1 - 0.25 * np.clip(elevation, 0, 1))[..., None]
    return np.asarray(share * land + (1 - share) * sky)


def _pane(grid: Grid, pane: Rectangle) -> np.ndarray:
    """Return the coverage [H, W] of the glass of a window: the pane without its glazing bars."""
    x, y, _ = pane.place(grid.directions)
    upright, across = (0.05 - np.abs(x)) * pane.wide, (0.03 - np.abs(y - 0.35)) * pane.high
    bars = np.maximum(grid.share(upright), grid.share(across))
    thin = min(1.0, 0.1 * pane.wide / grid.pixel_rad)  # bars thinner than a pixel darken it in part
    return np.asarray(pane.cover(grid.directions, grid.pixel_rad) * (1 - thin * bars))


def _sunlit(grid: Grid, room: Room, pane: Rectangle, random: Random) -> np.ndarray:
    """Return the cosine [H, W] of the sun on the surfaces that it reaches through a window."""
    sun = room.box.turn @ toward(pane.azimuth_deg + random.uniform(-35, 35), random.uniform(15, 50))
    sun = sun.astype(np.float32)
    points = room.points * 0.999
    distance, _ = room.box.hits(points, np.broadcast_to(sun, points.shape))
    entry = points + distance[..., None] * sun
    entry /= np.linalg.norm(entry, axis=-1, keepdims=True)
    share = pane.cover(entry @ room.box.turn, 0.03)
    return np.asarray(share * np.clip(room.normals @ sun, 0, None))


def hall(grid: Grid, random: Random) -> np.ndarray:
    """Draw a large room, such as an office or a shop, with rows of lights on its ceiling."""
    room, lights = draw_room(grid, random, (0.25, 0.75), largest_m=10.0), RoomLights(grid)
    spacing_m = random.uniform(1.2, 3.5, 2)
    size_m = random.choice([np.array([0.09, 0.09]), np.array([0.6, 0.15]), np.array([0.3, 0.3])])
    offset_m = random.uniform(0, 1, 2) * spacing_m
    above = room.normals[..., 1] < -0.5
    foot_m = grid.pixel_rad * np.linalg.norm(room.points, axis=-1) + 1e-3
    share = above.astype(float)
    for axis, spacing, size, offset in zip((0, 2), spacing_m, size_m, offset_m, strict=True):
        away = np.abs((room.points[..., axis] - offset + spacing / 2) % spacing - spacing / 2)
        share = share * np.clip((size - away) / foot_m + 0.5, 0, 1) * np.minimum(1, 2 * size / foot_m)
    level = np.exp(random.uniform(0.5, 2.0)) * 0.35 / float(size_m.prod())
    radiance = paint(share, draw_white(random, 0.1, 1.1) * min(level, 250.0))
    lights.image += radiance
    for x in np.arange(offset_m[0] - 3 * spacing_m[0], 3 * spacing_m[0], spacing_m[0]):
        for z in np.arange(offset_m[1] - 3 * spacing_m[1], 3 * spacing_m[1], spacing_m[1]):
            _add_ceiling_light(room, lights, radiance, np.array([x, room.box.high[1], z]), size_m)
    if random.random() < 0.5:
        pane = Rectangle(random.uniform(-180, 180), 2.0, random.uniform(0.1, 0.6), random.uniform(0.1, 0.4))
        day = _pane(grid, pane)[..., None] * _outside(grid, random) * np.exp(random.uniform(0.5, 3))
        lights.add(pane.centre, day, flat=True)
    return lights.image + room.lit(lights) * (1 - share)[..., None]


def _add_ceiling_light(
    room: Room, lights: RoomLights, radiance: np.ndarray, at_m: np.ndarray, size_m: np.ndarray
) -> None:
    """Add a ceiling light at `at_m` [3] (m, box axes), of half sizes [2], if it lies inside the room."""
    inside = ((at_m >= room.box.low) & (at_m <= room.box.high)).all()
    if not inside or len(lights.sources) >= _MAX_HALL_LIGHTS:
        return
    distance = float(np.linalg.norm(at_m))
    solid = 4 * float(size_m.prod()) * at_m[1] / distance**3
    lights.sources.append((at_m / distance @ room.box.turn, radiance.max((0, 1)) * solid, False))


def studio(grid: Grid, random: Random) -> np.ndarray:
    """Draw a photo studio: softboxes, strip lights and bare bulbs between dark to white walls."""
    room, lights = draw_room(grid, random, (0.001, 0.6)), RoomLights(grid)
    if random.random() < 0.5:
        room = _with_backdrop(grid, random, room)
    for _ in range(random.integers(1, 5)):
        at = (random.uniform(-180, 180), random.uniform(-10, 60))
        box = Rectangle(*at, random.uniform(0.08, 0.6), random.uniform(0.15, 0.7))
        x, y, _ = box.place(grid.directions)
        hot = np.clip(1 - 0.25 * (x * x + y * y), 0, 1)  # brighter at the centre
        face = box.cover(grid.directions, grid.pixel_rad) * hot
        lights.add(
            box.centre, paint(face, draw_white(random, 0.1, 0.5) * np.exp(random.uniform(2, 6))), flat=True
        )
    for _ in range(random.integers(0, 3)):
        centre = toward(random.uniform(-180, 180), random.uniform(0, 70))
        radius_deg = np.exp(random.uniform(-1.4, 1.1))
        light = draw_white(random, 0.2, 0.9) * np.exp(random.uniform(5, 8)) / radius_deg**2
        lights.add(centre, paint(disc(grid, centre, radius_deg), light), flat=False)
    return lights.image + room.lit(lights)


def _with_backdrop(grid: Grid, random: Random, room: Room) -> Room:
    """Hang a paper backdrop down a wall and over the floor."""
    paper = random.choice([0.85, 0.8, 0.45, 0.2]) * np.array([1, 1, 1.0])
    middle, half = random.uniform(-np.pi, np.pi), random.uniform(0.35, 1.2)
    away = np.abs((grid.azimuths_rad - middle + np.pi) % (2 * np.pi) - np.pi)
    across = grid.share(half - away)
    below = grid.share(random.uniform(0.2, 0.6) - grid.elevations_rad)
    spread = grid.share(grid.elevations_rad + 1.1)
    share = (across * below * spread)[..., None]
    albedo = room.albedo + share * (paper - room.albedo)
    return replace(room, albedo=albedo)


def stage(grid: Grid, random: Random) -> np.ndarray:
    """Draw a nearly black hall with two to six strongly coloured lights."""
    room, lights = draw_room(grid, random, (0.005, 0.25), largest_m=10.0), RoomLights(grid)
    for _ in range(random.integers(2, 7)):
        rgb = 0.05 + random.dirichlet([0.5, 0.5, 0.5])
        centre = toward(random.uniform(-180, 180), random.uniform(-10, 75))
        spot = disc(grid, centre, random.uniform(1, 10))
        lights.add(centre, paint(spot, rgb * np.exp(random.uniform(3, 6))), flat=False)
    return lights.image + room.lit(lights)
