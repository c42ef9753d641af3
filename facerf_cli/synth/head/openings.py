"""Mesh of the skin in (u, level), with the eyes and the mouth cut out.

(u, level) are the coordinates of `cranium.py`. Samples near an outline move onto it before the cut, so that
the rim is a smooth curve and not a staircase. Nothing here depends on the person, because the landmarks of
the UV map, which are the same for all heads, define the openings.
"""

from dataclasses import dataclass
from functools import cache

import numpy as np
import torch
from scipy.interpolate import CubicSpline
from scipy.spatial.distance import cdist

from facerf_cli.face.topology import LANDMARK_UV, UV_SIZE_MM, grid_uv
from facerf_cli.run.workers import one_thread
from facerf_cli.synth.head.cranium import BACK_U, CROWN_LEVEL, NECK_LEVEL
from facerf_cli.synth.head.mesh import arc_lengths

# Landmarks along the upper and the lower edge of an opening; the right eye mirrors the left one.
_ARCS = {"eye_left": ([36, 37, 38, 39], [39, 40, 41, 36]), "mouth": ([*range(60, 65)], [64, 65, 66, 67, 60])}
_ROWS_PER_COLUMN = 0.75  # makes cells about square on the skin
_GROWTH, _COARSEST_MM = 1.1, 3.5  # growth per cell away from the face, and largest cell
_RELAXATIONS, _RELAXED_MM = 8, 5.0  # steps that even out samples near the rim, and their reach
_BLURRED_MM, _SOURCE_MM, _SIDE_MM, _CORNER_MM = 0.4, 6.0, 6.0, 2.0  # distances from an outline; see `lips`
_SMOOTHING = 0.5  # of the thin-plate spline


@dataclass(frozen=True, eq=False)
class Sheet:
    """Samples [N, 2] as (u, level), triangles [F, 3], and the rim of each cut opening as vertex ids in order.

    `same` [N] is the vertex that represents the place of each sample; the two sides of the seam share places.
    """

    u_level: np.ndarray
    triangles: np.ndarray
    rims: dict[str, np.ndarray]
    same: np.ndarray


@cache  # all heads share it
def skin_sheet(subdivisions: int, cut: tuple[str, ...]) -> Sheet:
    """Mesh the skin of the whole head, with the openings named in `cut` cut out."""
    columns = 128 * 2**subdivisions
    rows = round(columns * _ROWS_PER_COLUMN)
    u = _columns(columns)
    level = _levels(rows)
    grid = np.stack(np.meshgrid(u, level), -1)  # [R, C, 2], the pole left out
    u_level = np.concatenate([grid.reshape(-1, 2), [[0.5, CROWN_LEVEL]]])
    triangles = _triangles(len(level), len(u))
    ids = np.arange(len(u_level))
    same = ids.copy()
    same[:-1].reshape(len(level), len(u))[:, -1] = ids[:-1].reshape(len(level), len(u))[:, 0]
    rims = {}
    for name in cut:
        u_level, triangles, rims[name] = _cut(u_level, triangles, outline(name))
    used, packed = np.unique(triangles, return_inverse=True)
    renumber = np.full(len(u_level), -1)
    renumber[used] = np.arange(len(used))
    return Sheet(
        u_level[used],
        packed.reshape(-1, 3),
        {name: renumber[rim] for name, rim in rims.items()},
        renumber[same[used]],
    )


def outline(name: str) -> np.ndarray:
    """Closed outline [N, 2] of an opening in (u, v): dense, with its corners among the points."""
    if name == "eye_right":
        return outline("eye_left") * [-1, 1] + [1, 0]
    arcs = [_smooth(LANDMARK_UV[list(arc)] * UV_SIZE_MM) for arc in _ARCS[name]]
    return np.concatenate([arc[:-1] for arc in arcs]) / UV_SIZE_MM


@dataclass(frozen=True, eq=False)
class Lip:
    """Side of an opening, a lid or a lip, extrapolated into the opening.

    The face's vertices `replaced` [M] are weighted sums, with `weights` [M, N], of the vertices `sources` [N]
    on this side.
    """

    name: str
    upper: bool
    replaced: np.ndarray
    sources: np.ndarray
    weights: np.ndarray

    def holds(self, uv: np.ndarray) -> np.ndarray:
        """[N] bool: samples at uv [N, 2] that belong to this side."""
        line, points = outline(self.name) * UV_SIZE_MM, uv * UV_SIZE_MM
        left, right = line[:, 0].min(), line[:, 0].max()
        low, high = line[:, 1].min() - _SIDE_MM, line[:, 1].max() + _SIDE_MM
        inside = (points[:, 0] > left) & (points[:, 0] < right) & (points[:, 1] > low) & (points[:, 1] < high)
        return inside & (_above(points, line) == self.upper)


@cache  # slow, and all heads share it
def lips(name: str) -> tuple[Lip, Lip]:
    """Return the upper and the lower side of an opening, each extrapolated into it.

    The canonical mesh drops from the lid to the eyeball, and from lip to lip, within a cell or two. A finely
    sampled rim would show that drop.
    """
    points, line = grid_uv().double().numpy() * UV_SIZE_MM, outline(name) * UV_SIZE_MM
    signed, _ = _signed(points, line)
    corners = line[[0, len(line) // 2]]
    between = (points[:, 0] > corners[:, 0].min()) & (points[:, 0] < corners[:, 0].max())
    at_corner = (np.abs(points[:, None] - corners).max(-1) < _CORNER_MM).any(-1)
    above = _above(points, line)
    sides = []
    for upper in (True, False):
        own = above == upper
        opening = (signed > -_BLURRED_MM) | (~own & between & (signed > -_SIDE_MM) & ~at_corner)
        sources = np.flatnonzero(~opening & (signed > -_SOURCE_MM) & (own | at_corner))
        replaced = np.flatnonzero(opening)
        weights = _thin_plate(points[sources], points[replaced])
        sides.append(Lip(name, upper, replaced, sources, weights))
    return sides[0], sides[1]


def _thin_plate(known: np.ndarray, wanted: np.ndarray) -> np.ndarray:
    """Return the weights [M, N] of a thin-plate spline that extrapolates values at `known` to `wanted`."""

    def rows(points: np.ndarray) -> np.ndarray:
        squared = cdist(points, known, "sqeuclidean")
        plate = 0.5 * squared * np.log(np.maximum(squared, 1e-12))
        return np.concatenate([plate, np.ones((len(points), 1)), points - known.mean(0)], 1)

    system = np.zeros((len(known) + 3,) * 2)
    system[: len(known)] = rows(known)
    system[len(known) :, : len(known)] = system[: len(known), len(known) :].T
    system[np.arange(len(known)), np.arange(len(known))] += _SMOOTHING
    with one_thread():  # rounding in numpy's solver depends on the number of cores
        solved = torch.linalg.solve(torch.from_numpy(system.T), torch.from_numpy(rows(wanted).T))
    return solved.numpy().T[:, : len(known)]


def _above(points: np.ndarray, line: np.ndarray) -> np.ndarray:
    """[N] bool: points [N, 2] above the middle between the two arcs of an outline (v runs down)."""
    half = len(line) // 2
    arcs = (line[: half + 1], np.concatenate([line[half:], line[:1]]))
    margins = [np.interp(points[:, 0], *arc[np.argsort(arc[:, 0])].T) for arc in arcs]
    return np.asarray(points[:, 1] < np.mean(margins, 0))


def _smooth(points: np.ndarray, steps: int = 12) -> np.ndarray:
    """Return a spline through points [K, 2], sampled `steps` times between neighbours."""
    length = arc_lengths(points)
    knots = np.arange(len(points))
    at = np.interp(np.linspace(0, knots[-1], knots[-1] * steps + 1), knots, length)
    return CubicSpline(length, points)(at)


def _graded(start: float, total: float, step: float, coarsest: float) -> np.ndarray:
    """Return positions after `start` up to `start + total`, in steps that grow from `step` to `coarsest`."""
    steps = [step]
    while sum(steps) < total:
        steps.append(min(steps[-1] * _GROWTH, coarsest))
    return start + np.cumsum(steps) * total / sum(steps)


def _columns(columns: int) -> np.ndarray:
    """u of the columns of samples: `columns` cells over the face, coarser ones around the head."""
    inside = np.linspace(0, 1, columns + 1)
    beyond = _graded(1, BACK_U - 1, 1 / columns, _COARSEST_MM * 256 / columns / 165)
    return np.concatenate([1 - beyond[::-1], inside, beyond])


def _levels(rows: int) -> np.ndarray:
    """Levels of the rows of samples: `rows` cells over the face, coarser ones above and below."""
    inside = np.linspace(0, 1, rows + 1)
    coarsest = _COARSEST_MM * 192 / rows / UV_SIZE_MM[1]
    above = _graded(0, -CROWN_LEVEL, 1 / rows, coarsest)[:-1]
    below = _graded(1, NECK_LEVEL - 1, 1 / rows, coarsest)
    return np.concatenate([-above[::-1], inside, below])


def _triangles(rows: int, columns: int) -> np.ndarray:
    """Build triangles [F, 3], counter-clockwise from outside: a grid mirrored at the midline, a polar fan."""
    row, col = np.meshgrid(np.arange(rows - 1), np.arange(columns - 1), indexing="ij")
    tl = (row * columns + col).ravel()
    tr, bl, br = tl + 1, tl + columns, tl + columns + 1
    left = (col < columns // 2).reshape(-1, 1)
    first = np.where(left, np.stack([tl, bl, br], -1), np.stack([tl, bl, tr], -1))
    second = np.where(left, np.stack([tl, br, tr], -1), np.stack([tr, bl, br], -1))
    crown = np.arange(columns - 1)
    fan = np.stack([np.full(columns - 1, rows * columns), crown, crown + 1], -1)
    return np.concatenate([first, second, fan])


def _cut(
    uv: np.ndarray, triangles: np.ndarray, closed: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Cut a closed outline out of samples: moved samples, the triangles outside it, and the rim in order."""
    points, polygon = uv * UV_SIZE_MM, closed * UV_SIZE_MM
    low, high = polygon.min(0) - 2 * _RELAXED_MM, polygon.max(0) + 2 * _RELAXED_MM
    near = np.flatnonzero(((points > low) & (points < high)).all(-1))
    local = np.full(len(points), -1)
    local[near] = np.arange(len(near))
    touched = (local[triangles] >= 0).all(-1)
    faces = local[triangles[touched]]
    moved, side = _snapped(points[near], faces, polygon)
    within = (side[faces] >= 0).all(-1)
    flat = within & (side[faces] == 0).all(-1)
    within[flat] = _signed(moved[faces[flat]].mean(1), polygon)[0] > 0
    moved = _relaxed(moved, faces[~within], side, polygon)
    result = points.copy()
    result[near] = moved
    keep = np.ones(len(triangles), bool)
    keep[np.flatnonzero(touched)[within]] = False
    return result / UV_SIZE_MM, triangles[keep], near[_rim(faces[within])]


def _snapped(points: np.ndarray, faces: np.ndarray, polygon: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Points after one end of every edge that crosses the outline is moved onto it, and their side.

    The side [N] is 1 inside, 0 on and -1 outside the outline.
    """
    signed, nearest = _signed(points, polygon)
    edges = _edges(faces)
    crossing = edges[signed[edges[:, 0]] * signed[edges[:, 1]] < 0]
    distance = np.abs(signed[crossing])
    distance = distance + np.where(signed[crossing] > 0, 0, 1e-6)  # breaks ties alike on both halves
    snap = np.unique(crossing[np.arange(len(crossing)), distance.argmin(-1)])
    moved, side = points.copy(), np.sign(signed).astype(int)
    moved[snap], side[snap] = nearest[snap], 0
    corners = polygon[[polygon[:, 0].argmin(), polygon[:, 0].argmax()]]
    for corner in corners:
        on = np.flatnonzero(side == 0)
        moved[on[np.linalg.norm(points[on] - corner, axis=-1).argmin()]] = corner
    return moved, side


def _edges(faces: np.ndarray) -> np.ndarray:
    """Directed edges [3 F, 2] of triangles [F, 3]."""
    return np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])


def _signed(points: np.ndarray, polygon: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the distance [N] to the outline, positive inside, and its nearest points [N, 2]."""
    start, along = polygon, np.roll(polygon, -1, 0) - polygon
    offset = points[:, None] - start
    fraction = np.clip((offset * along).sum(-1) / (along**2).sum(-1), 0, 1)
    feet = start + fraction[..., None] * along
    distance = np.linalg.norm(points[:, None] - feet, axis=-1)
    best = distance.argmin(-1)
    rows = np.arange(len(points))
    ends = np.roll(polygon, -1, 0)
    crosses = (points[:, None, 1] < start[:, 1]) != (points[:, None, 1] < ends[:, 1])
    slope = along[:, 0] / np.where(along[:, 1] == 0, 1, along[:, 1])
    inside = (crosses & (offset[..., 0] < offset[..., 1] * slope)).sum(-1) % 2 == 1
    return np.where(inside, 1, -1) * distance[rows, best], feet[rows, best]


def _relaxed(points: np.ndarray, faces: np.ndarray, side: np.ndarray, polygon: np.ndarray) -> np.ndarray:
    """Even out the samples outside the rim, so that none of their triangles stays squeezed."""
    edges = np.unique(np.sort(_edges(faces), -1), axis=0)
    count = np.bincount(edges.ravel(), minlength=len(points))
    distance = np.abs(_signed(points, polygon)[0])
    free = (side < 0) & (distance < _RELAXED_MM)
    strength = 0.5 * np.clip(1 - distance / _RELAXED_MM, 0, 1) * free
    for _ in range(_RELAXATIONS):
        total = np.zeros_like(points)
        np.add.at(total, edges[:, 0], points[edges[:, 1]])
        np.add.at(total, edges[:, 1], points[edges[:, 0]])
        mean = total / np.maximum(count, 1)[:, None]
        points = points + strength[:, None] * (mean - points)
    return points


def _rim(inner: np.ndarray) -> np.ndarray:
    """Return the border of the removed triangles, in order, counter-clockwise from outside."""
    pairs = {(int(a), int(b)) for a, b in _edges(inner)}
    onward = {a: b for a, b in pairs if (b, a) not in pairs}
    start = min(onward)
    rim = [start]
    while onward[rim[-1]] != start:
        rim.append(onward[rim[-1]])
    if len(rim) != len(onward):
        raise ValueError("opening: not one connected piece; use an outline that does not cross itself")
    return np.array(rim)
