"""Published colours of the ColorChecker Classic, and the matrix that maps a camera's colours to them.

The matrix is the least-squares solution among those that keep neutral colours neutral (Finlayson and Drew
1997, 'Constrained least-squares regression in color spaces'). The falloff of light over the chart is fitted
in alternation with it, as a plane in the logarithm of brightness, after Finlayson et al. 2015, 'The
alternating least squares technique for nonuniform intensity color correction'.
"""

from dataclasses import dataclass
from functools import cache

import numpy as np

from facerf_cli.capture.chart_patches import GREYS, centres
from facerf_cli.colour import colour_science, lab_d65, luminance

CHART_NAME = "ColorChecker24 - After November 2014"
_ITERATIONS = 12  # of matrix and light; the next one changes them by less than a thousandth
_STEEPEST = 0.3  # log of the light from patch to patch; charts are lit more evenly
_LARGEST_COLOUR_RATIO, _LEAST_LEVEL = 1e3, 1e-9  # keep logarithms and quotients of black images finite


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


@cache
def published_colours() -> np.ndarray:
    """Published colours [24, 3] in linear Rec.709 under D65, adapted from X-Rite's D50 values by Bradford."""
    science = colour_science()
    chart = science.CCS_COLOURCHECKERS[CHART_NAME]
    xyz = science.xyY_to_XYZ(list(chart.data.values()))
    return np.asarray(science.XYZ_to_RGB(xyz, "ITU-R BT.709", chart.illuminant, "Bradford"), np.float64)
