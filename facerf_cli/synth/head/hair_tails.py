"""Ponytails, buns and braids of hair: paths of wisps that begin at a knot."""

import numpy as np
from scipy.spatial import cKDTree

from facerf_cli.synth.head.hull import Hull
from facerf_cli.synth.head.mesh import unit

ROWS = 17  # points of a path
_WISPS = {"ponytail": 1300, "bun": 900, "braids": 1400}
_BRAIDS_M = np.array([0.072, -0.035, -0.012])  # begin of the braid on the image's right: below the ear
_BACK_M = 0.09  # from the middle of the skull to its back
_SHOULDER_M = -0.105  # height from which on a braid lies on the clothes
_STRAND_M = 0.007  # half width of a strand of a braid


def knot_m(hull: Hull, height_m: float) -> np.ndarray:
    """The place [3] at the back of the head, at this height, to which hair is combed."""
    far = hull.middle + 5 * np.array([0.0, max(height_m - hull.middle[1], 0.0), -_BACK_M])
    far[1] += min(height_m - hull.middle[1], 0.0)
    return np.asarray(far - (hull.height(far[None])[0] - 0.004) * hull.rays(far[None])[0])


def tail_paths(
    kind: str, person_m: np.ndarray, hull: Hull, height_m: float, random: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Draw paths and normals [W, ROWS, 3] of a ponytail, a bun or two braids.

    person_m [V, 3]: head and clothes, over which braids hang.
    """
    count = _WISPS[kind]
    share = np.linspace(0, 1, ROWS)[None, :, None]
    if kind == "braids":
        both = [_braid(person_m, side, count // 2, random) for side in (-1, 1)]
        paths, normals = (np.concatenate(column) for column in zip(*both, strict=True))
        return paths, normals
    knot = knot_m(hull, height_m)
    away = unit(knot - hull.middle)
    if kind == "bun":
        radius = random.uniform(0.024, 0.038)
        first, second = _across(random.normal(0, 1, (count, 3)))
        angle = 2 * np.pi * (random.uniform(0, 1, (count, 1, 1)) + 0.7 * share)
        shell = radius * random.uniform(0.8, 1, (count, 1, 1))
        around = np.cos(angle) * first[:, None] + np.sin(angle) * second[:, None]
        return knot + 0.85 * radius * away + shell * around, around
    offset = random.normal(0, 0.006, (count, 1, 3))
    length = random.uniform(0.14, 0.3) * random.uniform(0.75, 1.05, (count, 1, 1))
    out = 0.045 * (1 - (1 - np.minimum(share * 2, 1)) ** 2)
    fall = length * share**1.6
    paths = knot + offset * (1 + 2 * share) + out * away - fall * np.array([0, 1.0, 0])
    paths = hull.lifted(paths, 0.004)
    return paths, unit(paths - paths.mean(0))


def _braid(
    person_m: np.ndarray, side: int, count: int, random: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Paths and normals [W, ROWS, 3] of three strands that cross on their way down to the chest."""
    long_m, turns = random.uniform(0.18, 0.28), 3.5
    rows = np.linspace(0, 1, ROWS)
    middle = _BRAIDS_M * [side, 1, 1] + np.stack([0.012 * side * rows, -long_m * rows, 0 * rows], -1)
    front = person_m[person_m[:, 2] > 0]
    near = cKDTree(front[:, :2]).query_ball_point(middle[:, :2], 0.012)
    depth_m = np.array([front[ids, 2].max() if ids else -1.0 for ids in near])
    depth_m[middle[:, 1] > _SHOULDER_M] = -1.0  # beside the neck
    middle[:, 2] = np.maximum(middle[:, 2], np.maximum.accumulate(depth_m) + 0.016)
    middle[:, 2] = np.convolve(np.pad(middle[:, 2], 2, "edge"), np.full(5, 0.2), "valid")
    strand = np.arange(count) % 3
    phase = 2 * np.pi * (turns * rows + strand[:, None] / 3)
    across, depth = np.array([1.0, 0, 0]), np.array([0, 0, 1.0])
    crossed = 0.011 * np.sin(phase)[..., None] * across + 0.006 * np.sin(2 * phase)[..., None] * depth
    turn = random.uniform(0, 2 * np.pi, (count, 1, 1))
    within = _STRAND_M * np.sqrt(random.uniform(0, 1, (count, 1, 1)))
    spread = within * (np.cos(turn) * across + np.sin(turn) * depth)
    thinner = (1 - 0.5 * rows)[None, :, None]
    away = (crossed + spread) * thinner
    return middle + away, unit(away)


def _across(axes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Two unit vectors [N, 3] each, orthogonal to the axes [N, 3] and to each other."""
    axes = unit(axes)
    first = unit(np.cross(axes, np.where(np.abs(axes[:, :1]) < 0.9, [[1.0, 0, 0]], [[0, 1.0, 0]])))
    return first, np.cross(axes, first)


def tied(paths: np.ndarray, hull: Hull, height_m: float, layer_m: float) -> np.ndarray:
    """Paths [W, R, 3] that lie on the head and end in the knot, with as many points as before."""
    knot, rows = knot_m(hull, height_m), paths.shape[1]
    last = np.maximum(np.linalg.norm(paths - knot, axis=-1).argmin(1), 1)
    at = np.linspace(0, 1, rows) * last[:, None]
    low = np.minimum(at.astype(int), rows - 2)
    part = (at - low)[..., None]
    each = np.arange(len(paths))[:, None]
    cut = paths[each, low] * (1 - part) + paths[each, low + 1] * part
    cut = cut + np.linspace(0, 1, rows)[:, None] ** 2 * (knot - cut[:, -1:])
    above = np.maximum(hull.height(cut) - layer_m, 0)
    return hull.lifted(cut - above[..., None] * hull.rays(cut), 0.0015)
