"""Search for a ColorChecker Classic in an image: spots of one colour on a grid, with the chart's colours.

The colours decide, so other grids are not mistaken for a chart; a chart that is small, dim or half hidden may
be missed. `benchmarks/colour_charts.py` counts both errors.
"""

from collections.abc import Iterator
from itertools import permutations
from typing import Any

import numpy as np
from scipy import ndimage
from scipy.spatial import cKDTree
from skimage.measure import label, regionprops

from facerf_cli.capture.chart_colours import fit_colours
from facerf_cli.capture.chart_patches import (
    COLUMNS,
    ROWS,
    area_corners,
    four_turns,
    homography,
    project,
    sample,
    shrunk,
)

LARGEST_DELTA_E = 8.0  # mean of the 24 patches; good photographs of a chart have 1 to 4
# The search for spots.
_SEARCHED_PX = 800  # longest side of the searched image
_EDGES = (0.01, 0.02, 0.04, 0.08)  # of the encoded image, change per pixel that ends a spot
_BRIGHT_PERCENTILE, _GAMMA = 99.0, 2.4  # of that encoding
_LEAST_SPOT_PX, _LARGEST_SPOT = 16, 0.045  # area in pixels; share of the image, which a chart may fill
_LEAST_FULL, _LONGEST = 0.68, 3.0  # area over the product of the axes (rectangle: 0.75); ratio of the axes
# The search for grids.
_LEAST_ON_GRID = 12  # of 24; dark patches merge with the chart's frame
_MOST_GRIDS = 4
_NEAREST = 6  # neighbours of a point that are tried
_STEP_OF_SIDE = (0.9, 3.0)  # distance of neighbours over the side of a spot
_LARGEST_SIDE_RATIO = 2.0  # of sides of neighbours, and of steps across to steps along
_LEAST_SINE = 0.8  # of the angle between steps along and across; the diagonals of a grid have 0.7
_MISS = 0.25  # of a step: largest distance of a point from its predicted place

Place = tuple[int, int]


def find_chart(pixels: np.ndarray) -> np.ndarray | None:
    """Find a chart in a linear image [H, W, 3]; its 24 colours match to a mean delta E of `LARGEST_DELTA_E`.

    Returns the corners [4, 2] of the patches' area, clockwise from the dark skin patch; None without a chart.
    """
    small, scale = shrunk(pixels, _SEARCHED_PX)
    points, sides = even_spots(small)
    grids = find_lattices(points, sides, _LEAST_ON_GRID, COLUMNS - 1)[:_MOST_GRIDS]
    tries = [
        (float(fit_colours(sample(small, turned).colours).delta_e_after.mean()), turned)
        for grid in grids
        for corners_px in _placed(grid, points)
        if ((corners_px > 0) & (corners_px < small.shape[1::-1])).all()
        for turned in four_turns(corners_px)[::2]
    ]
    delta_e, best = min(tries, key=lambda found: found[0], default=(np.inf, np.empty(0)))
    return best * scale if delta_e <= LARGEST_DELTA_E else None


def even_spots(pixels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Find spots of one colour with an edge around them: centres [N, 2] and sides [N], in pixels."""
    bright = max(float(np.percentile(pixels, _BRIGHT_PERCENTILE)), 1e-12)
    encoded = (pixels / bright).clip(0, 1) ** (1 / _GAMMA)
    slope = np.max([ndimage.gaussian_gradient_magnitude(encoded[..., c], 1.0) for c in range(3)], 0)
    centres, sides = np.zeros((0, 2)), np.zeros(0)
    for edge in _EDGES:
        for spot in _spots(slope < edge):
            centre, side = np.array(spot.centroid)[::-1] + 0.5, np.sqrt(spot.area)
            if (
                not len(centres) or np.hypot(*(centres - centre).T).min() > side / 3
            ):  # else a spot of a lower threshold
                centres, sides = np.r_[centres, centre[None]], np.r_[sides, side]
    return centres, sides


def _spots(even: np.ndarray) -> Iterator[Any]:
    """Connected regions of a mask [H, W] that are about as wide as long, and filled."""
    for spot in regionprops(label(even, connectivity=1)):
        if not _LEAST_SPOT_PX <= spot.area <= _LARGEST_SPOT * even.size:
            continue
        long, short = spot.axis_major_length, spot.axis_minor_length
        if long < _LONGEST * short and spot.area > _LEAST_FULL * long * short:
            yield spot


def _placed(grid: dict[Place, int], points: np.ndarray) -> Iterator[np.ndarray]:
    """Corners [4, 2] of all charts that a grid, which may lack rows or columns of patches, can belong to."""
    places, images = np.array(list(grid)), points[list(grid.values())]
    for upright in (places, np.stack([places[:, 1], -places[:, 0]], -1)):  # a chart on its side
        low, high = upright.min(0), upright.max(0) - [COLUMNS - 1, ROWS - 1]
        for first_column in range(min(low[0], high[0]), max(low[0], high[0]) + 1):
            for first_row in range(min(low[1], high[1]), max(low[1], high[1]) + 1):
                local = upright - [first_column, first_row]
                inside = ((local >= 0) & (local < [COLUMNS, ROWS])).all(-1)
                if inside.sum() >= _LEAST_ON_GRID:
                    matrix = homography(local[inside].astype(float), images[inside])
                    yield project(matrix, area_corners())


def find_lattices(points: np.ndarray, sides: np.ndarray, least: int, reach: int) -> list[dict[Place, int]]:
    """Find grids of `least` points or more among points [N, 2] of spots with sides [N], best first.

    A grid is a dict from place to index of the point. A place counts steps from the first point, at most
    `reach` in each direction: first along, then across, which is clockwise from it on the screen.
    """
    if len(points) < least:
        return []
    tree = cKDTree(points)
    found: dict[frozenset[int], dict[Place, int]] = {}
    done: set[int] = set()  # in a grid
    for seed in range(len(points)):
        if seed in done:
            continue
        grown = [_grow(tree, sides, seed, reach, *steps) for steps in _steps(tree, sides, seed)]
        best = max(grown, key=_score, default={})
        if len(best) >= least:
            found[frozenset(best.values())] = best
            done.update(best.values())
    return sorted(found.values(), key=_score, reverse=True)


def _score(grid: dict[Place, int]) -> float:
    """Number of points of a grid times the share of filled places, which is low for one along a diagonal."""
    return len(grid) ** 2 / float(np.prod(np.ptp(list(grid), axis=0) + 1))


def _steps(tree: cKDTree, sides: np.ndarray, seed: int) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Pairs of steps [2] from a point to two neighbours at about a right angle, the second clockwise."""
    low, high = (share * sides[seed] for share in _STEP_OF_SIDE)
    off, near = tree.query(tree.data[seed], k=min(_NEAREST + 1, len(sides)))
    kept = near[(off > low) & (off < high) & _alike(sides[near], sides[seed])]
    for one, other in permutations(kept, 2):
        along, across = tree.data[one] - tree.data[seed], tree.data[other] - tree.data[seed]
        lengths = np.hypot(*along), np.hypot(*across)
        sine = (along[0] * across[1] - along[1] * across[0]) / (lengths[0] * lengths[1])
        if sine > _LEAST_SINE and _alike(*lengths):
            yield along, across


def _alike(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    return (one < _LARGEST_SIDE_RATIO * other) & (other < _LARGEST_SIDE_RATIO * one)


def _grow(
    tree: cKDTree, sides: np.ndarray, seed: int, reach: int, along: np.ndarray, across: np.ndarray
) -> dict[Place, int]:
    """Grow a grid from a point and two steps; each step is predicted by the one before it."""
    grid, steps = {(0, 0): seed}, {(0, 0): (along, across)}
    todo, members = [(0, 0)], {seed}
    while todo:
        place = todo.pop(0)
        for axis, sign in ((0, 1), (0, -1), (1, 1), (1, -1)):
            there = (place[0] + sign * (axis == 0), place[1] + sign * (axis == 1))
            if there in grid or max(map(abs, there)) > reach:
                continue
            step = steps[place][axis]
            start = tree.data[grid[place]]
            off, index = tree.query(start + sign * step)
            fits = off < _MISS * np.hypot(*step) and _alike(sides[index], sides[grid[place]])
            if index in members or not fits:
                continue
            members.add(index)
            taken = sign * (tree.data[index] - start)
            grid[there] = int(index)
            steps[there] = (taken, steps[place][1]) if axis == 0 else (steps[place][0], taken)
            todo.append(there)
    return grid
