"""Colour corrections of a capture's cameras from photographs of a ColorChecker Classic.

Patches are numbered in reading order: six per row, from dark skin to black. Pixel centres lie at index + 0.5.

A chart's image is treated like a frame: decoded by the capture's colour space, less the black level, divided
by the lights' rgb. The light on the chart is assumed to have the mean rgb of all lights, at luminance 1. The
matrix is colour-science's least-squares solution (G. Finlayson et al., *Color correction using root-
polynomial regression*, 2015, degree 1) from the measured colours to the published ones, at the luminance that
the chart's greys have, so it does not change the unit of light.
"""

import hashlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from skimage.draw import polygon
from skimage.transform import estimate_transform

from facerf_cli.capture.capture import Capture, ChartCorrection, read_frame
from facerf_cli.errors import InputError, UsageError
from facerf_cli.image.colour import colour_science, lab_d65, luminance
from facerf_cli.run.logs import counted

CHART_NAME = "ColorChecker24 - After November 2014"
ROWS, COLUMNS = 4, 6
PATCHES = ROWS * COLUMNS
GREYS = slice(18, 24)  # white to black, the last row
PATCH_SIDE = 0.87  # of the grid's pitch; the rest is the chart's black frame
MIDDLE_SIDE = 0.45  # of the pitch: the sampled square, away from edges and from inaccurate corners
CAMERA_FIELD = "{camera}"
LARGEST_DELTA_E = 8.0  # mean of the 24 patches; good photographs of a chart have 1 to 4
_CLIPPED_WHITE = 0.85  # ratio of white to the next grey, relative to the published one
_LEAST_LEVEL = 1e-9  # luminance of the greys; avoids a division by 0 for black images

# Fit the map from points [N, 2] to points [N, 2] by least squares.
homography = partial(estimate_transform, "projective")


@dataclass(frozen=True, eq=False)
class ColourFit:
    """Fit of 24 measured colours to the published ones: its matrix [3, 3], and CIE delta E 2000 [24]."""

    matrix: np.ndarray
    delta_e_before: np.ndarray
    delta_e_after: np.ndarray


def fit_colours(measured: np.ndarray) -> ColourFit:
    """Fit a colour matrix to measured colours [24, 3], linear Rec.709."""
    science, published = colour_science(), published_colours()
    measured_greys, published_greys = (luminance(colours[GREYS].sum(0)) for colours in (measured, published))
    scaled = measured / max(float(measured_greys / published_greys), _LEAST_LEVEL)
    matrix = science.matrix_colour_correction(scaled, published, "Finlayson 2015", degree=1)

    def delta_e(linear: np.ndarray) -> np.ndarray:
        return np.asarray(science.delta_E(lab_d65(linear), lab_d65(published), method="CIE 2000"))

    return ColourFit(matrix, delta_e(scaled), delta_e(scaled @ matrix.T))


def published_colours() -> np.ndarray:
    """Return colours [24, 3] in linear Rec.709 under D65, adapted by Bradford from X-Rite's D50 values."""
    science = colour_science()
    chart = science.CCS_COLOURCHECKERS[CHART_NAME]
    xyz = science.xyY_to_XYZ(list(chart.data.values()))
    return np.asarray(science.XYZ_to_RGB(xyz, "ITU-R BT.709", chart.illuminant, "Bradford"), np.float64)


def area_corners() -> np.ndarray:
    """Return the corners [4, 2] of the patches' area on a grid of pitch 1, clockwise from dark skin."""
    size = np.array([COLUMNS, ROWS]) - 1 + PATCH_SIDE
    return np.array([[0, 0], [1, 0], [1, 1], [0, 1]]) * size - PATCH_SIDE / 2


def sample(pixels: np.ndarray, corners_px: np.ndarray) -> np.ndarray:
    """Return the median colours [24, 3] of the patches of an image [H, W, 3]; black without pixels."""
    row, column = np.divmod(np.arange(PATCHES), COLUMNS)
    square = MIDDLE_SIDE / 2 * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])
    on_grid = np.stack([column, row], -1)[:, None] + square
    squares_px = homography(area_corners(), corners_px)(on_grid.reshape(-1, 2)).reshape(-1, 4, 2) - 0.5
    patches = [pixels[polygon(corners[:, 1], corners[:, 0], pixels.shape[:2])] for corners in squares_px]
    return np.array([np.median(patch, 0) if len(patch) else np.zeros(3) for patch in patches])


def read_charts(capture: Capture, image: str, corners_px: Sequence[np.ndarray]) -> Iterator[ChartCorrection]:
    """Yield the corrections from one image for all cameras, or from one per camera with {camera} in its name.

    corners_px contains, for each image, the corners [4, 2] of the patches' area, clockwise from the dark skin
    patch. Raises InputError for an image without a usable chart, UsageError for corners of another number of
    images.
    """
    cameras = [[camera] for camera in capture.cameras] if CAMERA_FIELD in image else [list(capture.cameras)]
    if len(corners_px) != len(cameras):
        raise UsageError(
            f"--chart-corners: has corners of {counted(len(corners_px), 'image')}, but --colour-chart names "
            f"{len(cameras)}; use 'x,y x,y x,y x,y' for each, separated by ;"
        )
    for names, corners in zip(cameras, corners_px, strict=True):
        yield _read_chart(capture, Path(image.replace(CAMERA_FIELD, names[0])), names, corners)


def _read_chart(capture: Capture, image: Path, cameras: list[str], corners_px: np.ndarray) -> ChartCorrection:
    decoded = read_frame(image, capture.colour_space)
    height, width = decoded.shape[:2]
    if not ((corners_px >= 0) & (corners_px <= [width, height])).all():
        raise InputError(f"{image}: --chart-corners lie outside its {width} x {height} pixels; correct them")
    mean_light = capture.intensities.mean(0)
    linear = capture.without_dark(sample(decoded, corners_px))
    measured = linear / (mean_light / luminance(mean_light)).astype(decoded.dtype)
    fit = fit_colours(measured)
    if not (mean := fit.delta_e_after.mean()) <= LARGEST_DELTA_E:
        raise InputError(
            f"{image}: the patches' colours differ from a ColorChecker Classic's by a mean CIE delta E 2000 "
            f"of {mean:.0f}; check the corners (clockwise from dark skin) and the colour space "
            f"'{capture.colour_space}'"
        )
    (white, grey), (published_white, published_grey) = (
        colours[GREYS][:2].max(-1) for colours in (measured, published_colours())
    )
    if white / grey < _CLIPPED_WHITE * published_white / published_grey:
        raise InputError(f"{image}: the chart's white patch is clipped; expose it less")
    record = {
        "picture": image.name,
        "picture_sha256": hashlib.sha256(image.read_bytes()).hexdigest(),
        "cameras": cameras,
        "corners_px": corners_px.round(2).tolist(),
        "matrix": fit.matrix.round(6).tolist(),  # rounded, so that datasets agree between processors
        "delta_e_2000": {
            when: {"mean": round(float(values.mean()), 2), "max": round(float(values.max()), 2)}
            for when, values in (("before", fit.delta_e_before), ("after", fit.delta_e_after))
        },
    }
    return ChartCorrection(image, record)
