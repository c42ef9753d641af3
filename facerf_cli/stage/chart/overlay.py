"""A picture for people: the chart as it was corrected, what was sampled, and what is published."""

from pathlib import Path

import numpy as np
from skimage.draw import polygon, polygon_perimeter

from facerf_cli.colour import luminance
from facerf_cli.files.images import write_display
from facerf_cli.stage.chart.colours import published_colours
from facerf_cli.stage.chart.correction import ChartCorrection, corrected
from facerf_cli.stage.chart.measure import as_a_frame
from facerf_cli.stage.chart.patches import GREYS, MIDDLE_SIDE, sample, shrunk, squares_px
from facerf_cli.stage.data.layouts import Capture, read_picture

_SIDE_PX = 1024  # what a screen shows
_INNER = 0.5  # of the sampled square: the published colour


def write_chart_overlays(capture: Capture, folder: Path) -> None:
    """Write `colour_chart.png`, or `colour_chart_CAMERA.png` where each camera has its own."""
    for chart in capture.charts:
        ending = f"_{chart.cameras[0]}" if len(capture.charts) > 1 else ""
        write_display(folder / f"colour_chart{ending}.png", chart_overlay(capture, chart))


def chart_overlay(capture: Capture, chart: ChartCorrection) -> np.ndarray:
    """The corrected picture [h, w, 3], linear, with the middles that were sampled outlined.

    It is as bright as the published white. In each outline stands the published colour: the better the
    correction, the less it is seen.
    """
    linear = as_a_frame(capture, read_picture(chart.picture, capture.colour_space))
    linear = corrected([chart], chart.cameras[0], linear)
    corners_px = np.array(chart.corners_px)
    white = sample(linear, corners_px).colours[GREYS][0]
    shown, scale = shrunk(linear / luminance(white) * luminance(published_colours()[GREYS][0]), _SIDE_PX)
    for square, inner, colour in zip(
        squares_px(corners_px / scale) - 0.5,
        squares_px(corners_px / scale, _INNER * MIDDLE_SIDE) - 0.5,
        published_colours(),
        strict=True,
    ):
        outline = polygon_perimeter(square[:, 1], square[:, 0], shown.shape[:2], clip=True)
        shown[outline] = 0 if luminance(colour) > 0.2 else 0.8
        shown[polygon(inner[:, 1], inner[:, 0], shown.shape[:2])] = colour
    return shown
