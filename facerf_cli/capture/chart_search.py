"""Search for a colour chart: spots of one colour on a grid, with the chart's colours.

The colours decide, so other grids are not mistaken for a chart; a chart that is small, dim or half hidden may
be missed. `benchmarks/colour_charts.py` counts both errors.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import permutations

import numpy as np
from scipy import ndimage
from scipy.spatial import cKDTree
from skimage.measure import label, regionprops
from skimage.transform import estimate_transform

from facerf_cli.capture.chart import (
    COLUMNS,
    LARGEST_DELTA_E,
    ROWS,
    area_corners,
    fit_colours,
    homography,
    sample,
)

_SEARCHED_PX = 800  # longest side of the searched image
# Spots.
_EDGES = (0.01, 0.02, 0.04, 0.08)  # of the encoded image, change per pixel that ends a spot
_BRIGHT_PERCENTILE, _GAMMA = 99.0, 2.4  # of that encoding
_LEAST_SPOT_PX, _LARGEST_SPOT = 16, 0.045  # area in pixels; share of the image, which a chart may fill
_LEAST_FULL, _LONGEST = 0.68, 3.0  # area over the product of the axes (rectangle: 0.75); ratio of the axes
# Grids.
_LEAST_ON_GRID = 12  # of 24; dark patches merge with the chart's frame
_MOST_GRIDS = 4
_NEAREST = 6  # neighbours of a spot that are tried
_STEP_OF_SIDE = (0.9, 3.0)  # distance of neighbours over the side of a spot
_LARGEST_SIDE_RATIO = 2.0  # of sides of spots, and of steps across to steps along
_LEAST_SINE = 0.8  # of the angle between steps along and across; the diagonals of a grid have 0.7
_MISS = 0.25  # of a step: largest distance of a spot from its place
_LEAST_FOR_PERSPECTIVE = 6  # places, two in each of two rows; others may tell it badly, or not at all
_QUARTER_TURN = np.array([[0, 1], [-1, 0]])


@dataclass(frozen=True, eq=False)
class SpotGrid:
    """Spots on a grid; a place counts steps from the first spot, along and, clockwise from it, across."""

    places: np.ndarray  # [K, 2] int
    spots: np.ndarray  # [K] indices

    @property
    def score(self) -> float:
        """Number of spots times the share of filled places, which is low for one along a diagonal."""
        return len(self.spots) ** 2 / float(np.prod(np.ptp(self.places, axis=0) + 1))


def find_chart(pixels: np.ndarray) -> np.ndarray | None:
    """Find a chart in a linear image [H, W, 3]; its 24 colours match to a mean delta E of `LARGEST_DELTA_E`.

    Returns the corners [4, 2] of the patches' area, clockwise from the dark skin patch; None without a chart.
    """
    small, scale = block_means(pixels, _SEARCHED_PX)
    centres, sides = find_spots(small)
    grids = sorted(find_grids(centres, sides), key=lambda grid: -grid.score)[:_MOST_GRIDS]
    tries = [
        (float(fit_colours(sample(small, corners_px).colours).delta_e_after.mean()), corners_px)
        for grid in grids
        for corners_px in _placed(grid.places, centres[grid.spots])
        if ((corners_px > 0) & (corners_px < small.shape[1::-1])).all()
    ]
    delta_e, best = min(tries, key=lambda found: found[0], default=(np.inf, np.empty(0)))
    return best * scale if delta_e <= LARGEST_DELTA_E else None


def block_means(pixels: np.ndarray, side_px: int) -> tuple[np.ndarray, int]:
    """Shrink an image [H, W, 3] to `side_px` or less by averaging square blocks; return it and their side.

    A block is never larger than the image's shorter side, so a thin image may stay longer than `side_px`.
    """
    scale = min(math.ceil(max(pixels.shape[:2]) / side_px), *pixels.shape[:2])
    height, width = (side // scale for side in pixels.shape[:2])
    blocks = pixels[: height * scale, : width * scale].reshape(height, scale, width, scale, 3)
    return blocks.mean((1, 3), dtype=np.float32), scale


def find_spots(pixels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Find spots of one colour, about as wide as long: centres [N, 2] and sides [N], in pixels.

    Of two that overlap, the one with the lower edge counts.
    """
    bright = max(float(np.percentile(pixels, _BRIGHT_PERCENTILE)), 1e-12)
    encoded = (pixels / bright).clip(0, 1) ** (1 / _GAMMA)
    slope = np.max([ndimage.gaussian_gradient_magnitude(encoded[..., c], 1.0) for c in range(3)], 0)
    centres, sides = np.zeros((0, 2)), np.zeros(0)
    for edge in _EDGES:
        for region in regionprops(label(slope < edge, connectivity=1)):
            if not _LEAST_SPOT_PX <= region.area <= _LARGEST_SPOT * slope.size:
                continue
            long, short = region.axis_major_length, region.axis_minor_length
            centre, side = np.array(region.centroid)[::-1] + 0.5, np.sqrt(region.area)
            is_new = not len(centres) or np.hypot(*(centres - centre).T).min() > side / 3
            if is_new and long < _LONGEST * short and region.area > _LEAST_FULL * long * short:
                centres, sides = np.r_[centres, centre[None]], np.r_[sides, side]
    return centres, sides


def find_grids(centres: np.ndarray, sides: np.ndarray) -> Iterator[SpotGrid]:
    """Yield grids of `_LEAST_ON_GRID` spots or more; each starts at a spot that is in none before it."""
    if len(centres) < _LEAST_ON_GRID:
        return
    tree, done = cKDTree(centres), set()
    for seed, side in enumerate(sides):
        if seed in done:
            continue
        alike = _alike(sides, side)
        steps = _steps(tree, seed, side, alike)
        grown = [_grow(centres, alike, seed, along, across) for along, across in steps]
        best = max(grown, key=lambda grid: grid.score, default=None)
        if best is not None and len(best.spots) >= _LEAST_ON_GRID:
            done.update(best.spots.tolist())
            yield best


def _steps(
    tree: cKDTree, seed: int, side: float, alike: np.ndarray
) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Pairs of steps [2] from a spot to two neighbours at about a right angle, the second clockwise."""
    low, high = (share * side for share in _STEP_OF_SIDE)
    off, near = tree.query(tree.data[seed], k=min(_NEAREST + 1, tree.n))
    steps = tree.data[near[(off > low) & (off < high) & alike[near]]] - tree.data[seed]
    for along, across in permutations(steps, 2):
        lengths = np.hypot(*along), np.hypot(*across)
        sine = (along[0] * across[1] - along[1] * across[0]) / (lengths[0] * lengths[1])
        if sine > _LEAST_SINE and _alike(*lengths):
            yield along, across


def _alike(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    return (one < _LARGEST_SIDE_RATIO * other) & (other < _LARGEST_SIDE_RATIO * one)


def _grow(
    centres: np.ndarray, alike: np.ndarray, seed: int, along: np.ndarray, across: np.ndarray
) -> SpotGrid:
    """Grow a grid of `alike` spots from one and two steps, ring by ring, each predicted by those within."""
    places = np.array([[0, 0], [1, 0], [0, 1]])
    images, spots = centres[seed] + places @ [along, across], np.array([seed])
    for ring in range(1, COLUMNS):
        in_rows = np.unique(places[:, 1], return_counts=True)[1]
        is_sure = len(places) >= _LEAST_FOR_PERSPECTIVE and (in_rows > 1).sum() > 1
        kind = "projective" if is_sure else "affine"
        on_grid = estimate_transform(kind, places, images).inverse(centres)
        nearest = np.rint(on_grid)
        fits = alike & (np.abs(nearest).max(1) <= ring) & (np.hypot(*(on_grid - nearest).T) < _MISS)
        found, first = np.unique(nearest[fits].astype(int), axis=0, return_index=True)
        if len(found) <= max(len(spots), 3):
            break
        places, spots = found, np.flatnonzero(fits)[first]
        images = centres[spots]
    return SpotGrid(places[: len(spots)], spots)


def _placed(places: np.ndarray, images: np.ndarray) -> Iterator[np.ndarray]:
    """Corners [4, 2] of all charts that a grid, which may lack rows or columns of patches, can belong to."""
    for _ in range(4):
        places = places @ _QUARTER_TURN
        low, high = np.sort([places.min(0), places.max(0) - [COLUMNS - 1, ROWS - 1]], axis=0)
        for first in np.ndindex(*(high - low + 1)):
            local = places - low - first
            inside = ((local >= 0) & (local < [COLUMNS, ROWS])).all(-1)
            if inside.sum() >= _LEAST_ON_GRID:
                yield homography(local[inside], images[inside])(area_corners())
