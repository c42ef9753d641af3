"""Colour corrections of a capture's cameras from photographs of a ColorChecker Classic.

Patches are numbered in reading order: six per row, from dark skin to black. Pixel centres lie at index + 0.5.

A chart's image is treated like a frame: decoded by the capture's colour space, less the black level, divided
by the lights' rgb. The light on the chart counts as that of all lights, so it has their mean rgb at luminance
1. The matrix is colour-science's least-squares solution (G. Finlayson et al., *Color correction using root-
polynomial regression*, 2015, degree 1) from the measured colours to the published ones, at the luminance that
the chart's greys have, so it does not change the unit of light.
"""

import hashlib
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from skimage.draw import polygon
from skimage.transform import estimate_transform

from facerf_cli.capture.capture import Capture, ChartCorrection, correct_colours, read_frame
from facerf_cli.errors import InputError, UsageError
from facerf_cli.files.image_metadata import read_header
from facerf_cli.files.write import write_display
from facerf_cli.image.colour import colour_science, lab_d65, luminance
from facerf_cli.image.strips import block_means
from facerf_cli.run.logs import counted

CHART_NAME = "ColorChecker24 - After November 2014"
ROWS, COLUMNS = 4, 6
PATCHES = ROWS * COLUMNS
GREYS = slice(18, 24)  # white to black, the last row
PATCH_SIDE = 0.87  # of the grid's pitch; the rest is the chart's black frame
MIDDLE_SIDE = 0.45  # of the pitch: the sampled square, away from edges and from inaccurate corners
CAMERA_FIELD = "{camera}"
# Thresholds beyond which a chart's image is refused.
LARGEST_DELTA_E = 8.0  # mean of the 24 patches; good photographs of a chart have 1 to 4
_LEAST_PX = 25  # in the middle of a patch
_AT_WHITE = 1e-4  # from 1, within which a value counts as the largest of an integer format
_CLIPPED_SHARE = 0.3  # of a patch's pixels
_CLIPPED_WHITE = 0.85  # of the white by the next grey
_LEAST_LEVEL = 1e-9  # of the greys' luminance: black images have quotients, too
# Control images.
_SIDE_PX = 1024  # fits a screen
_SQUARES = (MIDDLE_SIDE + 0.08, MIDDLE_SIDE, MIDDLE_SIDE / 2)  # sides of outline, sample and published colour

# A map from points [N, 2] to points [N, 2], by least squares.
homography = partial(estimate_transform, "projective")


@dataclass(frozen=True, eq=False)
class ColourFit:
    """Fit of 24 measured colours to the published ones: its matrix [3, 3], and CIE delta E 2000 [24]."""

    matrix: np.ndarray
    delta_e_before: np.ndarray
    delta_e_after: np.ndarray


def fit_colours(measured: np.ndarray) -> ColourFit:
    """Fit a colour matrix to measured colours [24, 3], linear Rec.709."""
    published = published_colours()
    greys, wanted = luminance(measured[GREYS].sum(0)), luminance(published[GREYS].sum(0))
    even = measured / max(float(greys / wanted), _LEAST_LEVEL)
    matrix = colour_science().matrix_colour_correction(even, published, "Finlayson 2015", degree=1)
    return ColourFit(matrix, delta_e_2000(even, published), delta_e_2000(even @ matrix.T, published))


def delta_e_2000(linear: np.ndarray, wanted: np.ndarray) -> np.ndarray:
    """CIE delta E 2000 [N] between linear Rec.709 colours [N, 3] under D65; white is 1."""
    return np.asarray(colour_science().delta_E(lab_d65(linear), lab_d65(wanted), method="CIE 2000"))


def published_colours() -> np.ndarray:
    """Published colours [24, 3] in linear Rec.709 under D65, adapted from X-Rite's D50 values by Bradford."""
    science = colour_science()
    chart = science.CCS_COLOURCHECKERS[CHART_NAME]
    xyz = science.xyY_to_XYZ(list(chart.data.values()))
    return np.asarray(science.XYZ_to_RGB(xyz, "ITU-R BT.709", chart.illuminant, "Bradford"), np.float64)


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


def patches(pixels: np.ndarray, corners_px: np.ndarray) -> list[np.ndarray]:
    """The pixels [N, 3] in the middle of each patch of an image [H, W, 3]."""
    squares = squares_px(corners_px) - 0.5
    return [pixels[polygon(square[:, 1], square[:, 0], pixels.shape[:2])] for square in squares]


def sample(pixels: np.ndarray, corners_px: np.ndarray) -> np.ndarray:
    """Median colours [24, 3] of the patches of an image [H, W, 3]; black for a patch without pixels."""
    inside = patches(pixels, corners_px)
    return np.array([np.median(patch, 0) if len(patch) else np.zeros(3) for patch in inside])


def four_turns(corners_px: np.ndarray) -> list[np.ndarray]:
    """Corners [4, 2] clockwise on the screen, once from each corner: the four orientations of a chart."""
    rolled = np.roll(corners_px, -1, 0)
    area = (corners_px[:, 0] * rolled[:, 1] - rolled[:, 0] * corners_px[:, 1]).sum()
    clockwise = corners_px if area > 0 else corners_px[::-1]
    return [np.roll(clockwise, -turn, 0) for turn in range(4)]


def read_charts(capture: Capture, image: str, corners_px: Sequence[np.ndarray]) -> Iterator[ChartCorrection]:
    """Yield the corrections from one image for all cameras, or from one per camera with {camera} in its name.

    corners_px has, for each image, the corners [4, 2] of the patches' area, in order around it. InputError
    for an image without a usable chart, UsageError for corners of another number of images.
    """
    each = CAMERA_FIELD in image
    if len(corners_px) != (wanted := len(capture.cameras) if each else 1):
        raise UsageError(
            f"--chart-corners: has corners of {counted(len(corners_px), 'image')}, and --colour-chart names "
            f"{wanted}; give 'x,y x,y x,y x,y' for each, separated by ;"
        )
    if not each:
        yield _read_chart(capture, Path(image), list(capture.cameras), corners_px[0], "colour_chart.png")
        return
    for camera, corners in zip(capture.cameras, corners_px, strict=True):
        named = Path(image.replace(CAMERA_FIELD, camera))
        yield _read_chart(capture, named, [camera], corners, f"colour_chart_{camera}.png")


def _normalise(capture: Capture, decoded: np.ndarray) -> np.ndarray:
    """Subtract the black level from values [..., 3], and divide by the lights' mean rgb at luminance 1."""
    mean = capture.intensities.mean(0)
    return capture.without_dark(decoded) / (mean / luminance(mean)).astype(decoded.dtype)


def _read_chart(
    capture: Capture, image: Path, cameras: list[str], corners_px: np.ndarray, overlay: str
) -> ChartCorrection:
    raw = read_frame(image, capture.colour_space)
    height, width = raw.shape[:2]
    if not ((corners_px >= 0) & (corners_px <= [width, height])).all():
        raise InputError(f"{image}: --chart-corners lie outside its {width} x {height} pixels; correct them")
    tries = [(fit_colours(_normalise(capture, sample(raw, one))), one) for one in four_turns(corners_px)]
    fit, corners_px = min(tries, key=lambda found: float(found[0].delta_e_after.mean()))
    for fault in _faults(capture, image, raw, corners_px, fit):
        raise InputError(f"{image}: {fault}")
    record = {
        "picture": image.name,
        "picture_sha256": hashlib.sha256(image.read_bytes()).hexdigest(),
        "cameras": cameras,
        "corners_px": corners_px.round(2).tolist(),
        "matrix": fit.matrix.round(6).tolist(),  # rounded, so that datasets agree between processors
        "delta_e_2000": {
            when: {"mean": round(float(of.mean()), 2), "max": round(float(of.max()), 2)}
            for when, of in (("before", fit.delta_e_before), ("after", fit.delta_e_after))
        },
        "overlay": overlay,
    }
    return ChartCorrection(image, record)


def _faults(
    capture: Capture, image: Path, raw: np.ndarray, corners_px: np.ndarray, fit: ColourFit
) -> Iterator[str]:
    """Faults of patches that are too small or clipped to measure, and of colours that are not a chart's."""
    if not (mean := fit.delta_e_after.mean()) <= LARGEST_DELTA_E:
        yield (
            f"the patches' colours differ from a ColorChecker Classic's by a mean CIE delta E 2000 "
            f"of {mean:.0f}; check the corners and the colour space '{capture.colour_space}'"
        )
    inside = patches(raw, corners_px)
    if (fewest := min(map(len, inside))) < _LEAST_PX:
        yield (
            f"a patch of the chart has only {fewest} pixels in its middle; photograph it larger, {_LEAST_PX} "
            "are needed"
        )
    clipped = sum((np.abs(patch - 1) < _AT_WHITE).any(-1).mean() > _CLIPPED_SHARE for patch in inside)
    header = read_header(image) if clipped else None
    if header and not header.is_floating:  # floating-point values may exceed 1
        yield f"{clipped} of the chart's patches are clipped at white; expose it less"
    (white, grey), (wanted, wanted_grey) = (
        colours[GREYS][:2].max(-1)
        for colours in (_normalise(capture, sample(raw, corners_px)), published_colours())
    )
    if white / grey < _CLIPPED_WHITE * wanted / wanted_grey:
        yield "the chart's white patch is clipped; expose it less"


def write_chart_overlays(capture: Capture, folder: Path) -> None:
    """Write each chart's image, corrected and of screen size, with its samples outlined, by its record."""
    for chart in capture.charts:
        linear = _normalise(capture, read_frame(chart.image, capture.colour_space))
        corrected = correct_colours([chart], chart.record["cameras"][0], linear)
        scale = min(math.ceil(max(corrected.shape[:2]) / _SIDE_PX), *corrected.shape[:2])
        small = block_means(corrected, scale)
        outlined = outline_patches(small, np.array(chart.record["corners_px"]) / scale)
        write_display(folder / chart.record["overlay"], outlined)


def outline_patches(pixels: np.ndarray, corners_px: np.ndarray) -> np.ndarray:
    """Scale an image [H, W, 3] to the published white, and outline the sampled middles of the patches.

    The published colour fills the centre of each outline, so a good correction makes it hard to see.
    """
    white, published = sample(pixels, corners_px)[GREYS][0], published_colours()
    plain = pixels * (luminance(published[GREYS][0]) / luminance(white))
    shown = plain.copy()
    squares = np.stack([squares_px(corners_px, side) for side in _SQUARES], 1) - 0.5
    for nested, colour in zip(squares, published, strict=True):
        outer, middle, inner = (polygon(one[:, 1], one[:, 0], shown.shape[:2]) for one in nested)
        shown[outer] = 0 if luminance(colour) > 0.2 else 0.8
        shown[middle] = plain[middle]
        shown[inner] = colour
    return shown
