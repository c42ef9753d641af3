"""Looks for a ColorChecker Classic in a picture: even spots on a grid whose colours are the chart's.

The colours decide: a grid of other things is no chart, so what is found may be believed, and what is not
found (small, dim, half hidden) has to be said. `benchmarks/colour_charts.py` counts both.
"""

from collections.abc import Iterator
from typing import Any

import numpy as np
from scipy import ndimage
from skimage.measure import label, regionprops

from facerf_cli.stage.chart.colours import fit_colours
from facerf_cli.stage.chart.lattice import Place, find_lattices
from facerf_cli.stage.chart.patches import (
    COLUMNS,
    ROWS,
    area_corners,
    four_turns,
    homography,
    project,
    sample,
    shrunk,
)

LARGEST_DELTA_E = 8.0  # mean of the patches'; a chart that was photographed well has 1 to 4
_SEARCHED_PX = 800  # a picture is made no longer than that
_EDGES = (0.01, 0.02, 0.04, 0.08)  # changes a pixel, of the encoded picture, that bound an even spot
_BRIGHT_PERCENTILE, _GAMMA = 99.0, 2.4
_LEAST_SPOT_PX, _LARGEST_SPOT = 16, 0.045  # the latter of the picture: a chart may fill it
_LEAST_FULL, _LONGEST = 0.68, 3.0  # area over the product of the axes, 0.75 for a rectangle; and their ratio
_LEAST_ON_GRID = 12  # of 24; the dark ones are lost in the chart's frame
_MOST_GRIDS = 4


def find_chart(pixels: np.ndarray) -> np.ndarray | None:
    """The corners [4, 2] of the patches' area, clockwise from dark skin's; None where no chart is seen.

    pixels [H, W, 3] are linear. The 24 colours are the chart's to a mean delta E of `LARGEST_DELTA_E`.
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
    """Centres [N, 2] and sides [N] in pixels of spots of one colour with an edge around them."""
    bright = max(float(np.percentile(pixels, _BRIGHT_PERCENTILE)), 1e-12)
    encoded = (pixels / bright).clip(0, 1) ** (1 / _GAMMA)
    slope = np.max([ndimage.gaussian_gradient_magnitude(encoded[..., c], 1.0) for c in range(3)], 0)
    centres, sides = np.zeros((0, 2)), np.zeros(0)
    for edge in _EDGES:
        for spot in _spots(slope < edge):
            centre, side = np.array(spot.centroid)[::-1] + 0.5, np.sqrt(spot.area)
            if not len(centres) or np.hypot(*(centres - centre).T).min() > side / 3:  # else known already
                centres, sides = np.r_[centres, centre[None]], np.r_[sides, side]
    return centres, sides


def _spots(even: np.ndarray) -> Iterator[Any]:
    """Connected parts of a mask [H, W] that are about as wide as long, and full."""
    for spot in regionprops(label(even, connectivity=1)):
        if not _LEAST_SPOT_PX <= spot.area <= _LARGEST_SPOT * even.size:
            continue
        long, short = spot.axis_major_length, spot.axis_minor_length
        if long < _LONGEST * short and spot.area > _LEAST_FULL * long * short:
            yield spot


def _placed(grid: dict[Place, int], points: np.ndarray) -> Iterator[np.ndarray]:
    """Where a chart can lie on a grid that shows only some of its patches: corners [4, 2] of each place."""
    places, images = np.array(list(grid)), points[list(grid.values())]
    for upright in (places, np.stack([places[:, 1], -places[:, 0]], -1)):  # on its side, the other way
        low, high = upright.min(0), upright.max(0) - [COLUMNS - 1, ROWS - 1]
        for first_column in range(min(low[0], high[0]), max(low[0], high[0]) + 1):
            for first_row in range(min(low[1], high[1]), max(low[1], high[1]) + 1):
                local = upright - [first_column, first_row]
                inside = ((local >= 0) & (local < [COLUMNS, ROWS])).all(-1)
                if inside.sum() >= _LEAST_ON_GRID:
                    matrix = homography(local[inside].astype(float), images[inside])
                    yield project(matrix, area_corners())
