"""Glasses that fit a synthetic head.

The rims stand in front of the eyes, as near as nose, brows and cheeks allow. A bridge leads over the nose,
and the temples lead along the head to the ears.
"""

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from facerf_cli.synth import tables_of
from facerf_cli.synth.head.mesh import HeadMesh, joined, ring_triangles, strandless, unit
from facerf_cli.synth.random_fields import Random

_LENSES = tables_of(__file__)
GLASSES = tuple(_LENSES)

_EYES = ((36, 39), (42, 45))  # landmarks of the corners
_GAP_M = 0.0012  # between frame and skin
_NEAR_M = 0.003  # skin within this radius of a point counts
_TUBE = 10  # vertices around a tube
_LENS_RADIUS_M, _LENS_RINGS = 0.12, 5  # of the sphere whose cap a lens is


@dataclass(frozen=True, eq=False)
class Glasses:
    """Frame, as part "frame", and lenses, which are transparent and so no part of the head's mesh."""

    frame: HeadMesh
    lenses: HeadMesh


def draw_glasses(head: HeadMesh, landmarks_m: np.ndarray, random: Random) -> Glasses:
    """Draw glasses for a bare head with these landmarks [68, 3]."""
    kind = str(random.choice(GLASSES))
    metal = kind == "aviator" or random.random() < 0.4
    # Half the depth and half the width of the frame.
    depth = random.uniform(0.0008, 0.0012) if metal else random.uniform(0.0013, 0.0019)
    width = random.uniform(0.0007, 0.0011) if metal else random.uniform(0.0012, 0.0026)
    surface = _HeadSurface(head)
    rims = _rims(kind, landmarks_m, random)
    rims = _settled(rims, surface, landmarks_m, depth + _GAP_M)
    parts = []
    for rim in rims:
        # Half-rim glasses have the upper half of a rim, and a little down both sides.
        visible = rim if kind != "half-rim" else np.roll(rim, 4, 0)[: len(rim) // 2 + 8]
        parts.append(_tube(visible, np.array([0, 0, 1.0]), width, depth, closed=kind != "half-rim"))
    parts.append(_bridge(rims, surface, width, depth, 0.15))
    if kind == "aviator":
        parts.append(_bridge(rims, surface, width, depth, 0.75))
    high = width if metal else random.uniform(0.0018, 0.004)
    parts += [_temple(rim, surface, depth, high) for rim in rims]
    return Glasses(joined(*parts), joined(*(_lens(rim) for rim in rims)))


def _lens(rim: np.ndarray) -> HeadMesh:
    """Return the front of a lens in its rim [64, 3]: a cap of a sphere."""
    count, centre = len(rim), rim.mean(0)
    axis = np.linalg.svd(rim - centre)[2][2]
    axis = axis * np.sign(axis[2])
    shares = np.linspace(0, 1, _LENS_RINGS)[:, None, None]
    flat = centre + shares * (rim - centre)
    away = flat - centre
    squares = (away**2).sum(-1, keepdims=True)
    bulge = (squares[-1:] - squares) / (2 * _LENS_RADIUS_M)
    points = (flat + bulge * axis).reshape(-1, 3)
    normals = unit(axis + away / _LENS_RADIUS_M).reshape(-1, 3)
    triangles = ring_triangles(_LENS_RINGS, count)
    return strandless("frame", points, normals, triangles, np.zeros((len(points), 2)))


class _HeadSurface:
    """Outermost skin and eyes of a head along the z or the x axis."""

    def __init__(self, head: HeadMesh) -> None:
        outer = head.is_part("skin", "eye")
        self.points = head.vertices[outer].astype(float)
        front = self.points[self.points[:, 2] > 0.02]
        self._front, self._front_z = cKDTree(front[:, :2]), front[:, 2]
        self._sides = {}
        for side in (-1, 1):
            flank = self.points[self.points[:, 0] * side > 0.03]
            self._sides[side] = cKDTree(flank[:, 1:]), flank[:, 0] * side

    def front(self, points: np.ndarray) -> np.ndarray:
        """z [N] of the frontmost skin at (x, y) of points [N, 3]."""
        return _greatest(self._front, self._front_z, points[:, :2])

    def flank(self, points: np.ndarray, side: int) -> np.ndarray:
        """|x| [N] of the outermost skin at (y, z) of points [N, 3]; side: sign of x."""
        return _greatest(*self._sides[side], points[:, 1:])

    def ear_top(self, side: int) -> tuple[float, float]:
        """Find (y, z) just above the ear: the first height, from the temple down, where the head juts out."""
        heights = np.arange(0.062, 0.015, -0.002)
        z = np.arange(-0.015, 0.026, 0.003)
        points = np.stack(np.broadcast_arrays(0, heights[:, None], z), -1).reshape(-1, 3)
        out = self.flank(points, side).reshape(len(heights), len(z))
        juts = out > out[0].max() + 0.005
        if not juts.any():
            return 0.04, 0.0
        row = int(juts.any(1).argmax())
        return float(heights[row]) + 0.003, float(z[juts[row]].mean())


def _greatest(tree: cKDTree, values: np.ndarray, at: np.ndarray) -> np.ndarray:
    """Return the greatest of `values` within `_NEAR_M` of each place [N, 2], or else the nearest one."""
    _, nearest = tree.query(at)
    return np.array(
        [
            values[near].max() if near else values[one]
            for near, one in zip(tree.query_ball_point(at, _NEAR_M), nearest, strict=True)
        ]
    )


def _rims(kind: str, landmarks_m: np.ndarray, random: Random) -> list[np.ndarray]:
    """Draw the outlines [64, 3] of both lenses, left in the image first, from the inner end over the top."""
    size = random.uniform(0.92, 1.08)
    half_width, half_height, power = _LENSES[kind]
    span = abs(landmarks_m[45, 0] - landmarks_m[36, 0]) / 0.089  # relative to the mean face
    half_width, half_height = half_width * size * span, half_height * size * random.uniform(0.95, 1.1)
    centres = [landmarks_m[list(pair)].mean(0) for pair in _EYES]
    apart = np.abs([centre[0] for centre in centres]).mean()
    apart = max(apart, half_width + 0.0085)  # room for the nose
    height = np.mean([centre[1] for centre in centres]) - random.uniform(0.001, 0.004)
    turn = np.linspace(0, 2 * np.pi, 64, endpoint=False)
    cos, sin = np.cos(turn), np.sin(turn)
    x = -np.sign(cos) * np.abs(cos) ** (2 / power)  # starts at the nose, at -x of the right rim
    y = np.sign(sin) * np.abs(sin) ** (2 / power)
    if kind == "aviator":  # a drop that hangs outward
        x = x * (1 - 0.12 * (y < 0) * np.abs(y)) + 0.10 * np.minimum(y, 0) * -1
        y = np.where(y < 0, 1.15 * y, 0.9 * y)
    x = apart + half_width * x
    y = half_height * y
    wrap, tilt = random.uniform(1.2, 2.4), np.tan(np.radians(random.uniform(3, 10)))
    z = -wrap * x**2 + tilt * y
    return [np.stack([side * x, y + height, z], -1) for side in (-1, 1)]


def _settled(
    rims: list[np.ndarray], surface: _HeadSurface, landmarks_m: np.ndarray, clear_m: float
) -> list[np.ndarray]:
    """Move rims in front of the face, as near as skin, lashes and the bridge of the nose allow."""
    need = max(float((surface.front(rim) + clear_m - rim[:, 2]).max()) for rim in rims)
    eyes = landmarks_m[np.arange(36, 48), 2].max() + 0.009  # room for the lashes
    need = max(need, eyes - float(np.mean([rim[:, 2].mean() for rim in rims])))
    return [rim + np.array([0, 0, need]) for rim in rims]


def _bridge(
    rims: list[np.ndarray], surface: _HeadSurface, width: float, depth: float, level: float
) -> HeadMesh:
    """Build a bar from rim to rim over the nose, at `level` (0..1) from the rims' middle to their top."""
    ends = []
    for rim in rims:
        inner = rim[np.argsort(np.abs(rim[:, 0]))[: len(rim) // 3]]
        height = rim[:, 1].mean() + level * np.ptp(rim[:, 1]) / 2
        ends.append(inner[np.argmin(np.abs(inner[:, 1] - height))])
    share = np.linspace(0, 1, 21)[:, None]
    path = ends[0] + (ends[1] - ends[0]) * share
    arch = 4 * share[:, 0] * (1 - share[:, 0])
    path[:, 1] += 0.003 * arch
    path[:, 2] += 0.002 * arch
    path[:, 2] = np.maximum(path[:, 2], surface.front(path) + depth + _GAP_M)
    path[1:-1, 2] = (path[:-2, 2] + 2 * path[1:-1, 2] + path[2:, 2]) / 4
    path[:, 2] += np.maximum(surface.front(path) + depth + 0.5 * _GAP_M - path[:, 2], 0).max() * arch**0.25
    return _tube(path, np.array([0, 0, 1.0]), width, depth, closed=False)


def _temple(rim: np.ndarray, surface: _HeadSurface, thick: float, high: float) -> HeadMesh:
    """Build a bar from the outer end of a rim along the head to the ear, and a little behind it."""
    side = int(np.sign(rim[:, 0].mean()))
    outer = rim[np.argsort(-np.abs(rim[:, 0]))[:20]]
    level = rim[:, 1].mean() + 0.35 * np.ptp(rim[:, 1]) / 2
    hinge = outer[np.argmin(np.abs(outer[:, 1] - level))]
    ear_y, ear_z = surface.ear_top(side)
    top = np.array([hinge[0], ear_y + high, ear_z])
    end = np.array([hinge[0], ear_y + high - 0.004, ear_z - 0.022])
    corner = hinge + np.array([side * 0.004, 0, -0.006])
    far = np.linspace(0, 1, 22)[1:, None]
    path = np.concatenate(
        [hinge[None], corner[None], corner + (top - corner) * far, top + (end - top) * far[6::7]]
    )
    out = np.maximum(surface.flank(path, side) + thick + _GAP_M, 0)
    out[:2] = np.maximum(out[:2], np.abs(path[:2, 0]))
    reach = np.abs(corner[0])
    behind = np.clip((corner[2] - path[:, 2]) / (corner[2] - ear_z), 0, 1)
    ear_out = out[-4]
    out = np.maximum(out, np.maximum(reach + (ear_out - reach) * behind, 0))
    path[:, 0] = side * out
    path[1:-1, 0] = np.maximum(np.abs(path[1:-1, 0]), np.abs(path[:-2, 0] + path[2:, 0]) / 2) * side
    return _tube(path, np.array([0, 1.0, 0]), thick, high, closed=False)


def _tube(path: np.ndarray, up: np.ndarray, across_m: float, up_m: float, closed: bool) -> HeadMesh:
    """Mesh a rounded bar along `path` [N, 3]; half thickness: `up_m` along `up`, `across_m` across it."""
    count = len(path)
    along = np.roll(path, -1, 0) - np.roll(path, 1, 0) if closed else np.gradient(path, axis=0)
    along = unit(along)
    aside = unit(np.cross(up, along))
    over = np.cross(along, aside)
    turn = np.linspace(0, 2 * np.pi, _TUBE, endpoint=False)
    cos, sin = np.cos(turn), np.sin(turn)
    square = 2 / 3.0  # a superellipse: flat sides, round edges
    a = (np.sign(cos) * np.abs(cos) ** square)[None, :, None]
    b = (np.sign(sin) * np.abs(sin) ** square)[None, :, None]
    offset = across_m * a * aside[:, None] + up_m * b * over[:, None]
    normal = a * aside[:, None] / across_m + b * over[:, None] / up_m
    vertices = path[:, None] + offset
    uv = np.stack(
        np.broadcast_arrays(np.linspace(0, 1, count)[:, None], np.linspace(0, 1, _TUBE)[None, :]), -1
    )
    rings = np.arange(count if closed else count - 1)
    here = rings[:, None] * _TUBE + np.arange(_TUBE)
    ahead = (rings[:, None] + 1) % count * _TUBE + np.arange(_TUBE)
    here_on, ahead_on = np.roll(here, -1, 1), np.roll(ahead, -1, 1)
    triangles = [np.stack([here, here_on, ahead], -1), np.stack([here_on, ahead_on, ahead], -1)]
    faces = np.concatenate([t.reshape(-1, 3) for t in triangles])
    if not closed:
        fan = np.stack(np.broadcast_arrays(0, np.arange(1, _TUBE - 1), np.arange(2, _TUBE)), -1)
        faces = np.concatenate([faces, fan[:, ::-1], fan + (count - 1) * _TUBE])
    return strandless("frame", vertices.reshape(-1, 3), normal.reshape(-1, 3), faces, uv.reshape(-1, 2))
