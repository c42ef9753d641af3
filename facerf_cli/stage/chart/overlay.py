"""A picture for people: the chart as it was corrected, what was sampled, and what is published."""

from pathlib import Path

import numpy as np
from skimage.draw import polygon

from facerf_cli.colour import luminance
from facerf_cli.files.images import write_display
from facerf_cli.stage.chart.colours import published_colours
from facerf_cli.stage.chart.correction import ChartCorrection, corrected
from facerf_cli.stage.chart.measure import as_a_frame
from facerf_cli.stage.chart.patches import GREYS, MIDDLE_SIDE, sample, shrunk, squares_px
from facerf_cli.stage.data.capture import Capture, read_picture

_SIDE_PX = 1024  # what a screen shows
_SQUARES = (MIDDLE_SIDE + 0.08, MIDDLE_SIDE, MIDDLE_SIDE / 2)  # the outline's, and the published colour's


def write_chart_overlays(capture: Capture, folder: Path) -> None:
    """Write each chart's picture, under its name of `ChartCorrection.overlay`."""
    for chart in capture.charts:
        write_display(folder / chart.overlay, chart_overlay(capture, chart))


def chart_overlay(capture: Capture, chart: ChartCorrection) -> np.ndarray:
    """The corrected picture [h, w, 3], linear, small enough for a screen, with what was sampled outlined."""
    linear = as_a_frame(capture, read_picture(chart.picture, capture.colour_space))
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
