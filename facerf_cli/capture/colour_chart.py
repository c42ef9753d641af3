"""From photographs of a colour chart to corrections of a capture's cameras; what is implausible is refused.

The picture goes the way of the frames: decoded by the capture's colour space, less the black level, over the
lamps' rgb. The chart's light is taken for that of all lamps, so it is their mean rgb, of luminance 1.

A picture for people: the chart as it was corrected, what was sampled, and what is published.
"""

import hashlib
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from skimage.draw import polygon

from facerf_cli.capture.capture import Capture, read_frame
from facerf_cli.capture.colour_correction import ChartCorrection, corrected
from facerf_cli.capture.find_colour_chart import (
    GREYS,
    LARGEST_DELTA_E,
    MIDDLE_SIDE,
    ColourFit,
    Patches,
    find_chart,
    fit_colours,
    four_turns,
    is_convex,
    published_colours,
    sample,
    shrunk,
    squares_px,
)
from facerf_cli.colour import luminance
from facerf_cli.errors import InputError, UsageError
from facerf_cli.files.images import read_header, write_display

CAMERA_FIELD = "{camera}"
_LEAST_PX = 25  # in the middle of a patch
_LARGEST_NOISE = 0.25  # of a pixel on the white patch, as a share of it
_LEAST_CHROMA = 0.02  # of a chart's colours; red and blue reach 1 and more
_CLIPPED_SHARE = 0.3  # of a patch's pixels
_CLIPPED_WHITE, _CLIPPED_CHANNEL = 0.85, 0.93  # of what the darker greys have white be; of another channel
_EXPONENTS = (0.8, 1.25)  # of the greys' brightness over what is published


def read_charts(capture: Capture, image: str, corners_px: np.ndarray | None) -> Iterator[ChartCorrection]:
    """The corrections of a capture's cameras by a picture, or, with {camera} in its name, by one a camera.

    corners_px [4, 2]: of the patches' area, in turn; None has the chart looked for.
    """
    if CAMERA_FIELD not in image:
        yield _read_chart(capture, Path(image), tuple(capture.cameras), corners_px, "colour_chart.png")
        return
    if corners_px is not None:
        raise UsageError(f"--chart-corners are of one picture; --colour-chart {image} names one a camera")
    for camera in capture.cameras:
        named = Path(image.replace(CAMERA_FIELD, camera))
        yield _read_chart(capture, named, (camera,), None, f"colour_chart_{camera}.png")


def as_a_frame(capture: Capture, decoded: np.ndarray) -> np.ndarray:
    """Values [..., 3] of a chart's picture less the black level, over the lamps' mean rgb of luminance 1."""
    mean = capture.intensities.mean(0)
    return (decoded - capture.black_level) / (mean / luminance(mean)).astype(decoded.dtype)


def _read_chart(
    capture: Capture, image: Path, cameras: tuple[str, ...], corners_px: np.ndarray | None, overlay: str
) -> ChartCorrection:
    raw = read_frame(image, capture.colour_space)
    if corners_px is None:
        corners_px = find_chart(as_a_frame(capture, raw))
        if corners_px is None:
            raise InputError(
                f"{image}: no ColorChecker Classic found in it; say where its 24 patches are with "
                "--chart-corners 'x,y x,y x,y x,y'"
            )
    _require_quadrilateral(image, raw, corners_px)
    tries = []
    for turned in four_turns(corners_px):
        patches = sample(raw, turned)
        fit = fit_colours(as_a_frame(capture, patches.colours))
        tries.append((float(fit.delta_e_after.mean()), turned, patches, fit))
    _, corners_px, patches, fit = min(tries, key=lambda found: found[0])
    _require_light(image, patches, capture.black_level)
    _require_chart(image, patches, fit, capture.colour_space)
    return ChartCorrection(
        image=image,
        image_sha256=hashlib.sha256(image.read_bytes()).hexdigest(),
        cameras=cameras,
        corners_px=_rows(corners_px, 2),
        matrix=_rows(fit.matrix, 6),  # so that no processor's last digits make another dataset
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
        raise InputError(f"{image}: --chart-corners lie outside its {width} x {height} pixels")
    if not is_convex(corners_px):
        raise InputError(f"{image}: --chart-corners make no convex quadrilateral; give them in turn around")


def _require_light(image: Path, patches: Patches, black_level: float) -> None:
    """Raise for patches whose pixels say too little of their colours."""
    if patches.counts.min() < _LEAST_PX:
        raise InputError(
            f"{image}: a patch of the chart has {patches.counts.min()} pixels in its middle; "
            f"{_LEAST_PX} are needed, photograph it larger"
        )
    greys = patches.colours[GREYS]
    brightest = (greys - black_level).max(0)
    if brightest.min() <= 0 or patches.noise[GREYS].max() > _LARGEST_NOISE * brightest[1]:
        raise InputError(f"{image}: the chart is too dark, or too noisy; expose it longer")
    clipped = int((patches.at_white > _CLIPPED_SHARE).sum())
    header = read_header(image) if clipped else None
    if header and not header.is_floating:  # floats go on beyond 1
        raise InputError(f"{image}: {clipped} of the chart's patches are clipped at white; expose it less")
    spread = np.ptp(patches.colours, -1) / greys.max()
    if spread.max() < _LEAST_CHROMA:
        raise InputError(f"{image}: is grey; a chart's correction needs a picture in colour")


def _require_chart(image: Path, patches: Patches, fit: ColourFit, colour_space: str) -> None:
    """Raise for colours that are no chart's, or not linear."""
    mean = fit.delta_e_after.mean()
    if mean > LARGEST_DELTA_E:
        raise InputError(
            f"{image}: the patches' colours are off a ColorChecker Classic's by a mean CIE delta E 2000 of "
            f"{mean:.0f}; look whether the corners are its patches', and '{colour_space}' its colour space"
        )
    greys, published = luminance(fit.even[GREYS]), luminance(published_colours()[GREYS])
    lit = slice(0, -1)  # black has stray light in it
    exponent = np.polyfit(np.log(published[lit]), np.log(greys[lit].clip(1e-6)), 1)[0]
    if not _EXPONENTS[0] < exponent < _EXPONENTS[1]:
        raise InputError(
            f"{image}: the chart's greys are not linear (as their power {exponent:.2f}); "
            f"'{colour_space}' is not how it was encoded, or a shadow or highlight lies on them"
        )
    values, wanted = fit.even[GREYS], published_colours()[GREYS]
    slopes = (values[1:4] * wanted[1:4]).sum(0) / (wanted[1:4] ** 2).sum(0)
    white = values[0] / (slopes * wanted[0])  # [3]; by the darker greys it would be 1
    if white.min() < max(_CLIPPED_WHITE, _CLIPPED_CHANNEL * white.max()):
        raise InputError(f"{image}: the chart's white patch is clipped; expose it less")


_SIDE_PX = 1024  # what a screen shows
_SQUARES = (MIDDLE_SIDE + 0.08, MIDDLE_SIDE, MIDDLE_SIDE / 2)  # the outline's, and the published colour's


def write_chart_overlays(capture: Capture, folder: Path) -> None:
    """Write each chart's picture, under its name of `ChartCorrection.overlay`."""
    for chart in capture.charts:
        write_display(folder / chart.overlay, chart_overlay(capture, chart))


def chart_overlay(capture: Capture, chart: ChartCorrection) -> np.ndarray:
    """The corrected picture [h, w, 3], linear, small enough for a screen, with what was sampled outlined."""
    linear = as_a_frame(capture, read_frame(chart.image, capture.colour_space))
    small, scale = shrunk(corrected([chart], chart.cameras[0], linear), _SIDE_PX)
    return outlined(small, np.array(chart.corners_px) / scale)


def outlined(pixels: np.ndarray, corners_px: np.ndarray) -> np.ndarray:
    """A picture [H, W, 3], as bright as the published white, with the middles that are sampled outlined.

    In each outline stands the published colour: the better the picture's colours, the less it is seen.
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
