"""The head around the chart: skull, sides and neck, bent smoothly onto the border of any face.

A table of section depths about the head's vertical axis gives an average head; its depths were measured on
the ICT-FaceKit mean, ears and shoulders taken away, and rounded to half a millimetre (none of its vertices
are in here). What the chart's border differs from it is carried outward by kriging, so that position and
slope go on across the border and the difference dies away over the skull.

The outside of a head as one height field, so that what is worn stays out of the skin.

The field is a capsule's: above the skull's middle a point is measured along the ray from that middle, below
it along the horizontal from the vertical line through it. So crown, neck and shoulders all have one radius
for every azimuth and arc, where arc is 0 at the middle's height, positive above, and negative below.
"""

from dataclasses import dataclass
from functools import cache

import numpy as np
import torch
from scipy.interpolate import RectBivariateSpline
from scipy.ndimage import distance_transform_edt, gaussian_filter, map_coordinates
from scipy.spatial.distance import cdist

from facerf_cli.face.topology import BOTTOM_M, GRID, HALF_ANGLE_DEG, TOP_M, grid_uv
from facerf_cli.synth.head.mesh import PARTS, HeadMesh, unit
from facerf_cli.synth.heads_bank import one_thread

BACK_U = 0.5 + 180 / (2 * HALF_ANGLE_DEG)  # the seam at the back of the head; the other one is 1 - BACK_U
_CROWN_MM_PER_DEG = 1.4  # of arc
CROWN_LEVEL = -90 * _CROWN_MM_PER_DEG / 1000 / (TOP_M - BOTTOM_M)
NECK_LEVEL = 1.506  # of the pole and of the neck's lower end; see `template`

_AZIMUTHS_DEG = (0, 16, 32, 48, 61, 73, 87, 103, 120, 140, 160, 180)
# Height in millimetres | distance from the axis; above 92 the rows are degrees of elevation about (0, 92, 0).
_CROWN_MM = """
 90 |  52.5  52.5  52.5 52.5 52.5 52.5 52.5 52.5 52.5 52.5 52.5 52.5
 70 |  56.5  56    55.5 55   54.5 54.5 54   53.5 53   52.5 52.5 52.5
 50 |  65    64    63   61   59.5 58.5 57.5 57   56.5 55.5 55   55
 32 |  78    76.5  73   69   66   64   63   62   61   60   59   58.5
 16 |  93    90.5  84   77.5 73   70.5 68.5 67.5 66.5 65.5 64   63.5
"""
_SECTIONS_MM = """
  92 | 108   106    96.5 87   81   77   75   73.5 73   72   70.5 70
  76 | 113.5 111.5 102   91   84.5 80.5 78   77   76.5 76   75   74.5
  59 | 117.5 116.5 106   92.5 85.5 81.5 79   78   78   77.5 77   76.5
  42 | 111   111   107.5 93   85.5 81   78   76.5 76.5 76.5 75.5 75.5
  25 | 108.5 109   106   95   84.5 78.5 75.5 73.5 73   72.5 72   72
   8 | 112.5 112   109   94.5 82.5 75   71.5 68.5 67   66.5 66   65.5
  -8 | 119   114.5 107.5 91.5 80   71.5 66.5 63   60.5 59   58.5 58
 -24 | 124   115   104   88.5 76   66.5 61.5 57.5 53.5 51.5 51   50.5
 -40 | 120.5 115   100   83.5 69.5 62.5 58.5 53.5 49.5 48.5 48   47.5
 -54 | 119.5 110    94   73.5 63   60   57   51.5 48.5 47.5 47   46.5
 -66 | 120   106.5  81   63   60   59   56   51.5 49   48.5 47.5 47.5
 -76 | 114    93    65.5 59   59   58.5 56   52.5 51   49.5 48.5 48.5
 -84 |  79.5  68    59   57   58   58.5 56.5 54.5 53.5 52   51   50.5
 -92 |  67    62.5  56.5 56   58   58   57   56   56   54.5 53   52.5
-104 |  61    57.5  54   55.5 57   58.5 59   60   60   58   56   56
-120 |  54    52.5  52   54   57   60   62.5 64   63.5 61.5 60   59.5
-140 |  48    48.5  50   53.5 58.5 63   67.5 70   69.5 66.5 64   63
-172 |  46    47.5  51   57   65   72.5 79   82.5 82   78   74   72
"""
_ROUNDING_MM = 0.3
_REACHES_MM = ((55.0, 1.0), (14.0, 0.03))  # how far the border's broad and its small differences are felt
_RING_STEP, _RING_INSIDE = 4, 5  # every fourth vertex of the border, and of a ring five cells further in
_SCALE_LIMITS = (0.85, 1.2)
_PAD = 6


def template(u: np.ndarray, level: np.ndarray) -> np.ndarray:
    """The average head [..., 3] in millimetres at (u, level) [...].

    `level` is the chart's v down from the chart's upper edge, and an arc's length over the crown above it:
    0 at `TOP_M`, `CROWN_LEVEL` at the pole.
    """
    azimuth_deg = (u - 0.5) * 2 * HALF_ANGLE_DEG
    length = -level * (TOP_M - BOTTOM_M) * 1000
    across, y = ((s.ev(length, azimuth_deg) + s.ev(length, -azimuth_deg)) / 2 for s in _profiles())
    azimuth = np.radians(azimuth_deg)
    return np.stack([across * np.sin(azimuth), y, across * np.cos(azimuth)], -1)


@cache
def _profiles() -> tuple[RectBivariateSpline, RectBivariateSpline]:
    """Distance from the axis and height, in millimetres, over (arc's length above the chart, azimuth)."""
    crown, sections = _table(_CROWN_MM), _table(_SECTIONS_MM)
    top = TOP_M * 1000
    elevation = np.radians(crown[:, :1])
    across = np.concatenate([crown[:, 1:] * np.cos(elevation), sections[:, 1:]])[::-1]
    heights = np.broadcast_to(sections[:, :1], sections[:, 1:].shape)
    y = np.concatenate([top + crown[:, 1:] * np.sin(elevation), heights])[::-1]
    length = np.concatenate([crown[:, 0] * _CROWN_MM_PER_DEG, sections[:, 0] - top])[::-1]
    half = np.array(_AZIMUTHS_DEG, float)
    azimuths = np.concatenate([half[-4:-1] - 360, -half[:0:-1], half, 360 - half[-2:-5:-1]])
    folded = np.where(np.abs(azimuths) > 180, 360 - np.abs(azimuths), np.abs(azimuths))
    column = np.searchsorted(half, folded)
    smoothing = across[:, column].size * _ROUNDING_MM**2
    return (
        RectBivariateSpline(length, azimuths, across[:, column], s=smoothing),
        RectBivariateSpline(length, azimuths, y[:, column], s=smoothing),
    )


def _table(text: str) -> np.ndarray:
    return np.array(
        [[float(cell) for cell in row.replace("|", " ").split()] for row in text.strip().splitlines()]
    )


def on_chart(vertices_mm: np.ndarray, uv: np.ndarray) -> np.ndarray:
    """The chart's surface [N, 3] at (u, v) [N, 2] inside it: a cubic spline through its vertices."""
    grid = vertices_mm.reshape(GRID, GRID, 3)
    padded = np.pad(grid, ((_PAD, _PAD), (_PAD, _PAD), (0, 0)), "reflect", reflect_type="odd")
    at = np.stack([uv[:, 1], uv[:, 0]]) * (GRID - 1) + _PAD
    return np.stack([map_coordinates(padded[..., axis], at, order=3) for axis in range(3)], -1)


class Surroundings:
    """The head beyond the chart at fixed (u, level) [N, 2], for many faces."""

    def __init__(self, u_level: np.ndarray) -> None:
        uv = grid_uv().double().numpy()
        self._rings = _rings()
        known = template(*uv[self._rings].T)
        self._known, self._wanted = known, template(*u_level.T)
        covariance = _kernel(known, known) + 1e-7 * np.eye(len(known))
        with one_thread():  # numpy's solver would round by the number of cores
            inverse = torch.linalg.inv(torch.from_numpy(covariance))
            chunks = np.array_split(self._wanted, 16)
            self._carry = torch.cat([(torch.from_numpy(_kernel(c, known)) @ inverse).float() for c in chunks])

    def positions(self, vertices_mm: np.ndarray) -> np.ndarray:
        """The surface [N, 3] in millimetres that goes on from the chart's `vertices_mm` [V, 3]."""
        border = vertices_mm[self._rings]
        scale, shift = _similarity(self._known, border)
        difference = border - (self._known * scale + shift)
        with one_thread():
            carried = self._carry @ torch.from_numpy(difference).float()
        return self._wanted * scale + shift + carried.numpy()


def _rings() -> np.ndarray:
    """Chart vertices [R] along its border and along a ring inside it."""
    rows = []
    for inside in (0, _RING_INSIDE):
        near, far = inside, GRID - 1 - inside
        along = np.unique([*range(near, GRID // 2, _RING_STEP), GRID // 2])
        along = np.unique([*along, *(GRID - 1 - along)])
        row, col = (axis.ravel() for axis in np.meshgrid(along, along, indexing="ij"))
        edge = (row == near) | (row == far) | (col == near) | (col == far)
        rows.append((row * GRID + col)[edge])
    return np.concatenate(rows)


def _kernel(a_mm: np.ndarray, b_mm: np.ndarray) -> np.ndarray:
    """Matern 5/2: twice differentiable, so that slopes go on across the border."""
    distance = cdist(a_mm, b_mm) * np.sqrt(5)
    return sum(
        share * (1 + distance / reach + (distance / reach) ** 2 / 3) * np.exp(-distance / reach)
        for reach, share in _REACHES_MM
    )


def _similarity(known: np.ndarray, border: np.ndarray) -> tuple[float, np.ndarray]:
    """Scale and shift [3] that bring the average head nearest to this one; the jaw, which moves, apart."""
    steady = known[:, 1] > -20
    a, b = known[steady], border[steady]
    centred = a - a.mean(0)
    scale = float(np.clip((centred * (b - b.mean(0))).sum() / (centred**2).sum(), *_SCALE_LIMITS))
    return scale, b.mean(0) - scale * a.mean(0)


_AZIMUTHS = 96
_ARC_M = 0.004  # height of a cell
_RADIUS_M = 0.09  # arc per radian of elevation
_LOWEST_M = -0.36  # arc of the lowest row
_MIDDLE_M = 0.045  # height of the capsule's middle: the widest part of the skull, above the ears
_SLICE_M = (0.07, 0.09)  # of heights, where front and back of the skull are looked for
_STEP_M = 0.002  # over which the field's slope is measured


@dataclass(frozen=True, eq=False)
class Hull:
    """Radius [rows, azimuths] in metres of the outermost surface about `middle` [3]; smooth and closed."""

    middle: np.ndarray
    radius: np.ndarray

    def height(self, points: np.ndarray) -> np.ndarray:
        """How far [...] outside the hull points [..., 3] lie, along the capsule's ray; negative inside."""
        out, azimuth, arc = self._coordinates(points)
        column = azimuth / (2 * np.pi) * _AZIMUTHS
        row = np.clip((arc - _LOWEST_M) / _ARC_M, 0, len(self.radius) - 1)
        padded = np.concatenate([self.radius, self.radius[:, :1]], 1)
        return out - map_coordinates(padded, [row, column % _AZIMUTHS], order=1, mode="nearest")

    def rays(self, points: np.ndarray) -> np.ndarray:
        """The unit direction [..., 3] in which the height of points [..., 3] is measured."""
        offset = points - self.middle
        offset = np.stack([offset[..., 0], np.maximum(offset[..., 1], 0), offset[..., 2]], -1)
        return unit(offset)

    def normals(self, points: np.ndarray) -> np.ndarray:
        """Unit normals [..., 3] of the level surfaces of height through points [..., 3]."""
        here = self.height(points)
        slope = np.stack([self.height(points + step) - here for step in np.eye(3) * _STEP_M], -1)
        return unit(slope)

    def lifted(self, points: np.ndarray, least: np.ndarray | float) -> np.ndarray:
        """Points [..., 3], those lower than `least` [...] pushed out to that height."""
        short = np.maximum(least - self.height(points), 0)
        return points + short[..., None] * self.rays(points)

    def _coordinates(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        x, y, z = np.moveaxis(points - self.middle, -1, 0)
        level = np.hypot(x, z)
        above = np.maximum(y, 0)
        arc = np.where(y > 0, _RADIUS_M * np.arctan2(above, level), y)
        return np.hypot(level, above), np.arctan2(x, z) % (2 * np.pi), arc


def hull_of(head: HeadMesh, smooth_cells: float = 0.8) -> Hull:
    """The hull of a head's skin, and of the clothes where it wears some."""
    corners = head.vertices[head.triangles[np.isin(head.part[head.triangles[:, 0]], _outer())]].astype(float)
    coarse = corners[np.linalg.norm(corners[:, 0] - corners[:, 1], axis=-1) > _ARC_M]
    sampled = [corners.mean(1), corners[:, 0], *(coarse[:, k] for k in (1, 2))]
    points = np.concatenate([*sampled, *((coarse[:, k] + coarse[:, k - 1]) / 2 for k in range(3))])
    hull = Hull(_middle(points), np.zeros((1, _AZIMUTHS)))
    out, azimuth, arc = hull._coordinates(points)
    rows = int((np.pi / 2 * _RADIUS_M - _LOWEST_M) / _ARC_M) + 2
    row = np.clip(np.rint((arc - _LOWEST_M) / _ARC_M).astype(int), 0, rows - 1)
    column = np.rint(azimuth / (2 * np.pi) * _AZIMUTHS).astype(int) % _AZIMUTHS
    radius = np.zeros((rows, _AZIMUTHS))
    np.maximum.at(radius, (row, column), out)
    return Hull(hull.middle, gaussian_filter(_filled(radius), smooth_cells, mode=("nearest", "wrap")))


def _outer() -> list[int]:
    return [PARTS.index("skin"), PARTS.index("cloth")]


def _middle(points: np.ndarray) -> np.ndarray:
    """The capsule's middle [3], halfway between the forehead and the back of the skull."""
    belt = points[(points[:, 1] > _SLICE_M[0]) & (points[:, 1] < _SLICE_M[1])]
    return np.array([0, _MIDDLE_M, (belt[:, 2].min() + belt[:, 2].max()) / 2])


def _filled(radius: np.ndarray) -> np.ndarray:
    """Cells that no point fell into take the nearest one's radius, around the back too."""
    third = radius.shape[1]
    tiled = np.tile(radius, (1, 3))
    nearest = distance_transform_edt(tiled == 0, return_distances=False, return_indices=True)
    return tiled[tuple(nearest)][:, third : 2 * third]
