"""The ColorChecker Classic: its colours and geometry, and the matrix from measured to published colours.

Patches are numbered in reading order: six per row, from dark skin to black. Pixel centres lie at index + 0.5.

The matrix is the least-squares solution among those that keep neutral colours neutral (Finlayson and Drew
1997, 'Constrained least-squares regression in color spaces'). The falloff of light over the chart is fitted
in alternation with it, as a plane in the logarithm of brightness, after Finlayson et al. 2015, 'The
alternating least squares technique for nonuniform intensity color correction'.
"""

from dataclasses import dataclass
from functools import partial

import numpy as np
from skimage.draw import polygon
from skimage.transform import estimate_transform

from facerf_cli.image.colour import colour_science, lab_d65, luminance

CHART_NAME = "ColorChecker24 - After November 2014"
_ITERATIONS = 12  # of matrix and light; the next one changes them by less than a thousandth
_STEEPEST = 0.3  # log of the light from patch to patch; charts are lit more evenly
_LARGEST_COLOUR_RATIO, _LEAST_LEVEL = 1e3, 1e-9  # keep logarithms and quotients of black images finite
ROWS, COLUMNS = 4, 6
PATCHES = ROWS * COLUMNS
GREYS = slice(18, 24)  # white to black, the last row
PATCH_SIDE = 0.87  # of the grid's pitch; the rest is the chart's black frame
MIDDLE_SIDE = 0.45  # of the pitch: the sampled square, away from edges and from inaccurate corners
LARGEST_DELTA_E = 8.0  # mean of the 24 patches; good photographs of a chart have 1 to 4
_SIGMA_OF_MAD = 1.4826  # standard deviation over median absolute deviation, of a normal distribution
_AT_WHITE = 1e-4  # from 1, within which a value counts as the largest of an integer format

homography = partial(
    estimate_transform, "projective"
)  # from points [N, 2] to points [N, 2], by least squares


@dataclass(frozen=True, eq=False)
class ColourFit:
    """Fit of 24 measured colours to the published ones."""

    matrix: np.ndarray  # [3, 3]; keeps the luminance of neutral colours
    even: np.ndarray  # [24, 3] measured colours without the falloff of light, scaled to the published level
    light: np.ndarray  # [24] relative light at each patch
    delta_e_before: np.ndarray  # [24] CIE 2000
    delta_e_after: np.ndarray  # [24]


def fit_colours(measured: np.ndarray) -> ColourFit:
    """Fit a colour matrix and the falloff of light to measured colours [24, 3], linear Rec.709."""
    published = published_colours()
    weight = luminance(published)  # stray light distorts dark patches
    plane = centres() - centres().mean(0)
    tilt = np.zeros(2)
    for _ in range(_ITERATIONS):
        light = np.exp(plane @ tilt)
        even = measured / light[:, None]
        matrix, level = neutral_matrix(even, published)
        ratio = luminance(even @ matrix.T) / (level * weight)
        height = np.log(ratio.clip(1 / _LARGEST_COLOUR_RATIO, _LARGEST_COLOUR_RATIO))
        sloped = np.linalg.lstsq(np.c_[plane, np.ones(len(plane))] * weight[:, None], height * weight)[0]
        tilt = (tilt + sloped[:2]).clip(-_STEEPEST, _STEEPEST)
    even = even / level
    before, after = delta_e_2000(even, published), delta_e_2000(even @ matrix.T, published)
    return ColourFit(matrix, even, light, before, after)


def neutral_matrix(measured: np.ndarray, wanted: np.ndarray) -> tuple[np.ndarray, float]:
    """Fit the matrix [3, 3] from colours [24, 3] to the wanted ones times a level; return both.

    The sum of the greys is mapped exactly, and the level keeps its luminance. Each row of the matrix is the
    least-norm solution of that constraint, plus the least-squares solution in the two free directions.
    """
    grey, wanted_grey = measured[GREYS].sum(0), wanted[GREYS].sum(0)
    level = max(float(luminance(grey) / luminance(wanted_grey)), _LEAST_LEVEL)
    along = level * np.outer(wanted_grey, grey) / max(float(grey @ grey), _LEAST_LEVEL**2)
    free = np.linalg.svd(grey[None])[2][1:]  # [2, 3], orthogonal to the greys
    left = level * wanted - measured @ along.T
    return along + np.linalg.lstsq(measured @ free.T, left)[0].T @ free, level


def delta_e_2000(linear: np.ndarray, wanted: np.ndarray) -> np.ndarray:
    """CIE delta E 2000 [N] between linear Rec.709 colours [N, 3] under D65; white is 1."""
    return np.asarray(colour_science().delta_E(lab_d65(linear), lab_d65(wanted), method="CIE 2000"))


def published_colours() -> np.ndarray:
    """Published colours [24, 3] in linear Rec.709 under D65, adapted from X-Rite's D50 values by Bradford."""
    science = colour_science()
    chart = science.CCS_COLOURCHECKERS[CHART_NAME]
    xyz = science.xyY_to_XYZ(list(chart.data.values()))
    return np.asarray(science.XYZ_to_RGB(xyz, "ITU-R BT.709", chart.illuminant, "Bradford"), np.float64)


@dataclass(frozen=True, eq=False)
class Patches:
    """Measured middles of the 24 patches."""

    colours: np.ndarray  # [24, 3] medians, float64; black for a patch without pixels
    counts: np.ndarray  # [24] pixels of each
    noise: np.ndarray  # [24] robust standard deviation of a pixel's green
    at_white: np.ndarray  # [24] share of pixels with a channel at 1, the largest value of integer formats


def centres() -> np.ndarray:
    """Patch centres [24, 2] (column, row) on a grid of pitch 1."""
    row, column = np.divmod(np.arange(PATCHES), COLUMNS)
    return np.stack([column, row], -1).astype(float)


def area_corners() -> np.ndarray:
    """Corners [4, 2] of the patches' area on that grid, clockwise from the dark skin patch."""
    size = np.array([COLUMNS, ROWS]) - 1 + PATCH_SIDE
    return np.array([[0, 0], [1, 0], [1, 1], [0, 1]]) * size - PATCH_SIDE / 2


def squares_px(corners_px: np.ndarray, side: float = MIDDLE_SIDE) -> np.ndarray:
    """Middle of each patch as a quadrilateral [24, 4, 2], from the corners [4, 2] of the patches' area."""
    square = side / 2 * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])
    grid_to_px = homography(area_corners(), corners_px)
    return grid_to_px((centres()[:, None] + square).reshape(-1, 2)).reshape(-1, 4, 2)


def sample(pixels: np.ndarray, corners_px: np.ndarray) -> Patches:
    """Measure the patches of an image [H, W, 3] between corners [4, 2] of the patches' area."""
    colours, counts = np.zeros((PATCHES, 3)), np.zeros(PATCHES, int)
    noise, at_white = np.zeros(PATCHES), np.zeros(PATCHES)
    for place, square in enumerate(squares_px(corners_px) - 0.5):
        inside = pixels[polygon(square[:, 1], square[:, 0], pixels.shape[:2])]
        if not len(inside):
            continue
        colours[place], counts[place] = np.median(inside, 0), len(inside)
        noise[place] = _SIGMA_OF_MAD * np.median(np.abs(inside[:, 1] - colours[place, 1]))
        at_white[place] = (np.abs(inside - 1) < _AT_WHITE).any(-1).mean()
    return Patches(colours, counts, noise, at_white)


def four_turns(corners_px: np.ndarray) -> list[np.ndarray]:
    """Corners [4, 2] clockwise on the screen, once from each corner: the four orientations of a chart."""
    rolled = np.roll(corners_px, -1, 0)
    area = (corners_px[:, 0] * rolled[:, 1] - rolled[:, 0] * corners_px[:, 1]).sum()
    clockwise = corners_px if area > 0 else corners_px[::-1]
    return [np.roll(clockwise, -turn, 0) for turn in range(4)]


def is_convex(corners_px: np.ndarray) -> bool:
    """Tell whether corners [4, 2] are those of a convex quadrilateral, in order around it."""
    edges = np.roll(corners_px, -1, 0) - corners_px
    ahead = np.roll(edges, -1, 0)
    bends = edges[:, 0] * ahead[:, 1] - edges[:, 1] * ahead[:, 0]
    return bool((bends > 0).all() or (bends < 0).all())
