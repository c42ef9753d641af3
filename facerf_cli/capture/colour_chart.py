"""Colour corrections of a capture's cameras from photographs of a colour chart, and their control images.

A chart's image is treated like a frame: decoded by the capture's colour space, less the black level, divided
by the lights' rgb. The light on the chart counts as that of all lights, so it has their mean rgb at luminance
1. Implausible charts are refused.
"""

import hashlib
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from skimage.draw import polygon

from facerf_cli.capture.capture import Capture, read_frame
from facerf_cli.capture.chart_colours import ColourFit, fit_colours, published_colours
from facerf_cli.capture.chart_correction import ChartCorrection, correct_colours
from facerf_cli.capture.chart_patches import (
    GREYS,
    MIDDLE_SIDE,
    Patches,
    four_turns,
    is_convex,
    sample,
    shrunk,
    squares_px,
)
from facerf_cli.capture.find_chart import LARGEST_DELTA_E, find_chart
from facerf_cli.colour import luminance
from facerf_cli.errors import InputError, UsageError
from facerf_cli.files.image_metadata import read_header
from facerf_cli.files.images import write_display

CAMERA_FIELD = "{camera}"
# Thresholds beyond which a chart's image is refused.
_LEAST_PX = 25  # in the middle of a patch
_LARGEST_NOISE = 0.25  # of a pixel, as a share of the white patch
_LEAST_CHROMA = 0.02  # of a chart's colours; red and blue reach 1 and more
_CLIPPED_SHARE = 0.3  # of a patch's pixels
_CLIPPED_WHITE, _CLIPPED_CHANNEL = (
    0.85,
    0.93,
)  # of the white that the darker greys predict; of another channel
_EXPONENTS = (0.8, 1.25)  # of the greys' brightness over the published one
# Control images.
_SIDE_PX = 1024  # fits a screen
_SQUARES = (MIDDLE_SIDE + 0.08, MIDDLE_SIDE, MIDDLE_SIDE / 2)  # sides of outline, sample and published colour


def read_charts(capture: Capture, image: str, corners_px: np.ndarray | None) -> Iterator[ChartCorrection]:
    """Yield the corrections from one image for all cameras, or from one per camera with {camera} in its name.

    corners_px [4, 2] are those of the patches' area, in order around it; None searches for the chart.
    InputError for an image without a usable chart, UsageError for corners with several images.
    """
    if CAMERA_FIELD not in image:
        yield _read_chart(capture, Path(image), tuple(capture.cameras), corners_px, "colour_chart.png")
        return
    if corners_px is not None:
        raise UsageError(
            f"--chart-corners: --colour-chart {image} names an image per camera; omit --chart-corners"
        )
    for camera in capture.cameras:
        named = Path(image.replace(CAMERA_FIELD, camera))
        yield _read_chart(capture, named, (camera,), None, f"colour_chart_{camera}.png")


def _normalise(capture: Capture, decoded: np.ndarray) -> np.ndarray:
    """Subtract the black level from values [..., 3], and divide by the lights' mean rgb at luminance 1."""
    mean = capture.intensities.mean(0)
    return (decoded - capture.black_level) / (mean / luminance(mean)).astype(decoded.dtype)


def _read_chart(
    capture: Capture, image: Path, cameras: tuple[str, ...], corners_px: np.ndarray | None, overlay: str
) -> ChartCorrection:
    raw = read_frame(image, capture.colour_space)
    if corners_px is None:
        corners_px = find_chart(_normalise(capture, raw))
        if corners_px is None:
            raise InputError(
                f"{image}: no ColorChecker Classic found; give the corners of its 24 patches with "
                "--chart-corners 'x,y x,y x,y x,y'"
            )
    _require_quadrilateral(image, raw, corners_px)
    tries = []
    for turned in four_turns(corners_px):
        patches = sample(raw, turned)
        fit = fit_colours(_normalise(capture, patches.colours))
        tries.append((float(fit.delta_e_after.mean()), turned, patches, fit))
    _, corners_px, patches, fit = min(tries, key=lambda found: found[0])
    _require_light(image, patches, capture.black_level)
    _require_chart(image, patches, fit, capture.colour_space)
    return ChartCorrection(
        image=image,
        image_sha256=hashlib.sha256(image.read_bytes()).hexdigest(),
        cameras=cameras,
        corners_px=_rows(corners_px, 2),
        matrix=_rows(fit.matrix, 6),  # rounded, so that datasets agree between processors
        delta_e_before=_mean_and_max(fit.delta_e_before),
        delta_e_after=_mean_and_max(fit.delta_e_after),
        light_span=round(float(fit.light.max() / fit.light.min()), 3),
        overlay=overlay,
    )


def _rows(values: np.ndarray, digits: int) -> tuple[tuple[float, ...], ...]:
    return tuple(tuple(round(float(value), digits) for value in row) for row in values)


def _mean_and_max(delta_e: np.ndarray) -> tuple[float, float]:
    return round(float(delta_e.mean()), 2), round(float(delta_e.max()), 2)


def _require_quadrilateral(image: Path, raw: np.ndarray, corners_px: np.ndarray) -> None:
    height, width = raw.shape[:2]
    if not ((corners_px >= 0) & (corners_px <= [width, height])).all():
        raise InputError(f"{image}: --chart-corners lie outside its {width} x {height} pixels; correct them")
    if not is_convex(corners_px):
        raise InputError(
            f"{image}: --chart-corners make no convex quadrilateral; give them in order around the chart"
        )


def _require_light(image: Path, patches: Patches, black_level: float) -> None:
    """Raise for patches that are too small, dark, noisy, clipped or grey to measure."""
    if patches.counts.min() < _LEAST_PX:
        raise InputError(
            f"{image}: a patch of the chart has only {patches.counts.min()} pixels in its middle; "
            f"photograph it larger, {_LEAST_PX} are needed"
        )
    greys = patches.colours[GREYS]
    brightest = (greys - black_level).max(0)
    if brightest.min() <= 0 or patches.noise[GREYS].max() > _LARGEST_NOISE * brightest[1]:
        raise InputError(f"{image}: the chart is too dark, or too noisy; expose it longer")
    clipped = int((patches.at_white > _CLIPPED_SHARE).sum())
    header = read_header(image) if clipped else None
    if header and not header.is_floating:  # floating-point values may exceed 1
        raise InputError(f"{image}: {clipped} of the chart's patches are clipped at white; expose it less")
    spread = np.ptp(patches.colours, -1) / greys.max()
    if spread.max() < _LEAST_CHROMA:
        raise InputError(f"{image}: is grey; give a photograph in colour")


def _require_chart(image: Path, patches: Patches, fit: ColourFit, colour_space: str) -> None:
    """Raise for colours that are not those of a chart, not linear, or clipped."""
    mean = fit.delta_e_after.mean()
    if mean > LARGEST_DELTA_E:
        raise InputError(
            f"{image}: the patches' colours differ from a ColorChecker Classic's by a mean CIE delta E 2000 "
            f"of {mean:.0f}; check the corners and the colour space '{colour_space}'"
        )
    greys, published = luminance(fit.even[GREYS]), luminance(published_colours()[GREYS])
    lit = slice(0, -1)  # stray light distorts black
    exponent = np.polyfit(np.log(published[lit]), np.log(greys[lit].clip(1e-6)), 1)[0]
    if not _EXPONENTS[0] < exponent < _EXPONENTS[1]:
        raise InputError(
            f"{image}: the chart's greys are not linear (they follow their power {exponent:.2f}); check the "
            f"colour space '{colour_space}', and look for a shadow or highlight on them"
        )
    values, wanted = fit.even[GREYS], published_colours()[GREYS]
    slopes = (values[1:4] * wanted[1:4]).sum(0) / (wanted[1:4] ** 2).sum(0)
    white = values[0] / (slopes * wanted[0])  # [3]; 1 in proportion to the darker greys
    if white.min() < max(_CLIPPED_WHITE, _CLIPPED_CHANNEL * white.max()):
        raise InputError(f"{image}: the chart's white patch is clipped; expose it less")


def write_chart_overlays(capture: Capture, folder: Path) -> None:
    """Write the control image of each chart under its name `ChartCorrection.overlay`."""
    for chart in capture.charts:
        write_display(folder / chart.overlay, chart_overlay(capture, chart))


def chart_overlay(capture: Capture, chart: ChartCorrection) -> np.ndarray:
    """Corrected image [h, w, 3] of a chart, linear and of screen size, with its samples outlined."""
    linear = _normalise(capture, read_frame(chart.image, capture.colour_space))
    small, scale = shrunk(correct_colours([chart], chart.cameras[0], linear), _SIDE_PX)
    return outline_patches(small, np.array(chart.corners_px) / scale)


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
