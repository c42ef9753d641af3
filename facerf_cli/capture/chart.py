"""Colour corrections of a capture's cameras from photographs of a ColorChecker Classic.

Patches are numbered in reading order: six per row, from dark skin to black. Pixel centres lie at index + 0.5.

The matrix is the least-squares solution among those that keep neutral colours neutral (Finlayson and Drew
1997, 'Constrained least-squares regression in color spaces'). The falloff of light over the chart is fitted
in alternation with it, as a plane in the logarithm of brightness, after Finlayson et al. 2015, 'The
alternating least squares technique for nonuniform intensity color correction'.

A chart's image is treated like a frame: decoded by the capture's colour space, less the black level, divided
by the lights' rgb. The light on the chart counts as that of all lights, so it has their mean rgb at luminance
1. Implausible charts are refused.
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

from facerf_cli.capture.capture import BlackLevel, Capture, ChartCorrection, correct_colours, read_frame
from facerf_cli.errors import InputError, UsageError
from facerf_cli.files.image_metadata import read_header
from facerf_cli.files.write import write_display
from facerf_cli.image.colour import colour_science, lab_d65, luminance
from facerf_cli.image.strips import block_means
from facerf_cli.run.logs import counted

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

# A map from points [N, 2] to points [N, 2], by least squares.
homography = partial(estimate_transform, "projective")
CAMERA_FIELD = "{camera}"
# Thresholds beyond which a chart's image is refused.
_LEAST_PX = 25  # in the middle of a patch
_LARGEST_NOISE = 0.25  # of a pixel, as a share of the white patch
_LEAST_CHROMA = 0.02  # of a chart's colours; red and blue reach 1 and more
_CLIPPED_SHARE = 0.3  # of a patch's pixels
_CLIPPED_WHITE, _CLIPPED_CHANNEL = 0.85, 0.93  # of the white by the darker greys; of another channel
_EXPONENTS = (0.8, 1.25)  # of the greys' brightness over the published one
# Control images.
_SIDE_PX = 1024  # fits a screen
_SQUARES = (MIDDLE_SIDE + 0.08, MIDDLE_SIDE, MIDDLE_SIDE / 2)  # sides of outline, sample and published colour


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
    if not is_convex(corners_px):
        advice = "give them in order around the chart"
        raise InputError(f"{image}: --chart-corners make no convex quadrilateral; {advice}")
    tries = []
    for turned in four_turns(corners_px):
        patches = sample(raw, turned)
        fit = fit_colours(_normalise(capture, patches.colours))
        tries.append((float(fit.delta_e_after.mean()), turned, patches, fit))
    _, corners_px, patches, fit = min(tries, key=lambda found: found[0])
    _refuse(image, _faults_of_light(image, patches, capture.black_level))
    _refuse(image, _faults_of_colours(fit, capture.colour_space))
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
        "light_span": round(float(fit.light.max() / fit.light.min()), 3),
        "overlay": overlay,
    }
    return ChartCorrection(image, record)


def _refuse(image: Path, faults: Iterator[str]) -> None:
    for fault in faults:
        raise InputError(f"{image}: {fault}")


def _faults_of_light(image: Path, patches: Patches, black_level: BlackLevel) -> Iterator[str]:
    """Faults of patches that are too small, dark, noisy, clipped or grey to measure."""
    if patches.counts.min() < _LEAST_PX:
        yield (
            f"a patch of the chart has only {patches.counts.min()} pixels in its middle; "
            f"photograph it larger, {_LEAST_PX} are needed"
        )
    greys = patches.colours[GREYS]
    brightest = (greys - np.asarray(black_level)).max(0)
    if brightest.min() <= 0 or patches.noise[GREYS].max() > _LARGEST_NOISE * brightest[1]:
        yield "the chart is too dark, or too noisy; expose it longer"
    clipped = int((patches.at_white > _CLIPPED_SHARE).sum())
    header = read_header(image) if clipped else None
    if header and not header.is_floating:  # floating-point values may exceed 1
        yield f"{clipped} of the chart's patches are clipped at white; expose it less"
    if (np.ptp(patches.colours, -1) / greys.max()).max() < _LEAST_CHROMA:
        yield "is grey; give a photograph in colour"


def _faults_of_colours(fit: ColourFit, colour_space: str) -> Iterator[str]:
    """Faults of colours that are not those of a chart, not linear, or clipped."""
    if (mean := fit.delta_e_after.mean()) > LARGEST_DELTA_E:
        yield (
            f"the patches' colours differ from a ColorChecker Classic's by a mean CIE delta E 2000 "
            f"of {mean:.0f}; check the corners and the colour space '{colour_space}'"
        )
    values, wanted = fit.even[GREYS], published_colours()[GREYS]
    greys, published = (luminance(colours[:-1]) for colours in (values, wanted))  # stray light distorts black
    exponent = np.polyfit(np.log(published), np.log(greys.clip(1e-6)), 1)[0]
    if not _EXPONENTS[0] < exponent < _EXPONENTS[1]:
        yield (
            f"the chart's greys are not linear (they follow their power {exponent:.2f}); check the "
            f"colour space '{colour_space}', and look for a shadow or highlight on them"
        )
    slopes = (values[1:4] * wanted[1:4]).sum(0) / (wanted[1:4] ** 2).sum(0)
    white = values[0] / (slopes * wanted[0])  # [3]; 1 in proportion to the darker greys
    if white.min() < max(_CLIPPED_WHITE, _CLIPPED_CHANNEL * white.max()):
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
    white, published = sample(pixels, corners_px).colours[GREYS][0], published_colours()
    plain = pixels * (luminance(published[GREYS][0]) / luminance(white))
    shown = plain.copy()
    squares = np.stack([squares_px(corners_px, side) for side in _SQUARES], 1) - 0.5
    for nested, colour in zip(squares, published, strict=True):
        outer, middle, inner = (polygon(one[:, 1], one[:, 0], shown.shape[:2]) for one in nested)
        shown[outer] = 0 if luminance(colour) > 0.2 else 0.8
        shown[middle] = plain[middle]
        shown[inner] = colour
    return shown
