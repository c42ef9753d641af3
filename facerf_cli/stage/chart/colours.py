"""The published colours of the ColorChecker Classic, and the matrix that takes a camera's to them.

The matrix is the least squares' among those that keep neutral colours neutral (Finlayson and Drew 1997,
'Constrained least-squares regression in color spaces'). Light that falls off over the chart is fitted beside
it in turn, as a plane in the logarithm of brightness, after Finlayson et al. 2015, 'The alternating least
squares technique for nonuniform intensity color correction'.
"""

import importlib
import sys
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np

from facerf_cli.colour import lab_d65, luminance
from facerf_cli.errors import FacerfError
from facerf_cli.stage.chart.patches import GREYS, centres

CHART_NAME = "ColorChecker24 - After November 2014"
_TURNS = 12  # of matrix and light; 12 leave less than a thousandth
_STEEPEST = 0.3  # of the light's logarithm from patch to patch: what is more is no chart
_LARGEST_RATIO, _LEAST_LEVEL = 1e3, 1e-9


@dataclass(frozen=True, eq=False)
class ColourFit:
    """How 24 measured colours become the chart's."""

    matrix: np.ndarray  # [3, 3]; keeps the luminance of neutral colours
    even: np.ndarray  # [24, 3] the measured colours, evenly lit and as bright as the chart's
    light: np.ndarray  # [24] the light at each patch
    delta_e_before: np.ndarray  # [24] CIE 2000
    delta_e_after: np.ndarray  # [24]


@cache
def colour_science() -> Any:
    """The package, which the type checker need not know; a user sees nothing of its import.

    It comes with the extra `chart`; a FacerfError says so where it is missing.
    """
    try:
        with np.printoptions(), warnings.catch_warnings(), _without("OpenImageIO"):
            warnings.simplefilter("ignore")  # it warns of optional packages that are not there
            return importlib.import_module("colour")
    except ImportError:
        raise FacerfError("--colour-chart needs colour-science; run pip install 'facerf[chart]'") from None


@contextmanager
def _without(name: str) -> Iterator[None]:
    """Hide a module from what is imported in the block.

    colour-science would hold types of OpenImageIO, which it prints as leaks when the program ends.
    """
    modules: dict[str, Any] = sys.modules
    hidden = modules.get(name)
    modules[name] = None  # Python's own way to say that there is none
    try:
        yield
    finally:
        del modules[name]
        if hidden is not None:
            modules[name] = hidden


@cache
def published_colours() -> np.ndarray:
    """Of the chart [24, 3] in linear Rec.709 under D65, by X-Rite's values under D50 and Bradford."""
    science = colour_science()
    chart = science.CCS_COLOURCHECKERS[CHART_NAME]
    xyz = science.xyY_to_XYZ(list(chart.data.values()))
    return np.asarray(science.XYZ_to_RGB(xyz, "ITU-R BT.709", chart.illuminant, "Bradford"), np.float64)


def fit_colours(measured: np.ndarray) -> ColourFit:
    """Fit the matrix and the light over the chart to measured colours [24, 3], linear Rec.709."""
    published = published_colours()
    weight = luminance(published)  # a dark patch has stray light in it
    plane = centres() - centres().mean(0)
    tilt = np.zeros(2)
    for _ in range(_TURNS):
        light = np.exp(plane @ tilt)
        even = measured / light[:, None]
        matrix, level = neutral_matrix(even, published)
        ratio = luminance(even @ matrix.T) / (level * weight)
        height = np.log(ratio.clip(1 / _LARGEST_RATIO, _LARGEST_RATIO))
        sloped = np.linalg.lstsq(np.c_[plane, np.ones(len(plane))] * weight[:, None], height * weight)[0]
        tilt = (tilt + sloped[:2]).clip(-_STEEPEST, _STEEPEST)
    even = even / level
    before, after = delta_e_2000(even, published), delta_e_2000(even @ matrix.T, published)
    return ColourFit(matrix, even, light, before, after)


def neutral_matrix(measured: np.ndarray, wanted: np.ndarray) -> tuple[np.ndarray, float]:
    """The matrix [3, 3] that takes 24 colours [24, 3] to the wanted ones times a level, and that level.

    The sum of the greys becomes exactly what it should be, and keeps its luminance: so is the level set. Each
    row is the least-norm solution of that, and the least squares' in the two directions that it leaves free.
    """
    grey, wanted_grey = measured[GREYS].sum(0), wanted[GREYS].sum(0)
    level = max(float(luminance(grey) / luminance(wanted_grey)), _LEAST_LEVEL)
    along = level * np.outer(wanted_grey, grey) / max(float(grey @ grey), _LEAST_LEVEL**2)
    free = np.linalg.svd(grey[None])[2][1:]  # [2, 3], orthogonal to the greys
    left = level * wanted - measured @ along.T
    return along + np.linalg.lstsq(measured @ free.T, left)[0].T @ free, level


def delta_e_2000(linear: np.ndarray, wanted: np.ndarray) -> np.ndarray:
    """CIE delta E 2000 [N] of linear Rec.709 colours [N, 3] under D65; white is 1."""
    return np.asarray(colour_science().delta_E(lab_d65(linear), lab_d65(wanted), method="CIE 2000"))
