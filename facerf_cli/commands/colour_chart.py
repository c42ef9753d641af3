"""The options --colour-chart and --chart-corners of `facerf prepare-dataset`."""

import logging
from dataclasses import replace
from typing import TYPE_CHECKING, Annotated

import typer

from facerf_cli.commands.prepare_item import Given
from facerf_cli.errors import InputError, UsageError
from facerf_cli.records import LOGGER_NAME

if TYPE_CHECKING:
    import numpy as np

ColourChartOption = Annotated[
    str,
    typer.Option(
        metavar="PICTURE",
        help="Correct the colours by this picture of a ColorChecker Classic under the stage's lamps; "
        "{camera} in its name: one a camera.",
        show_default=False,
    ),
]
ChartCornersOption = Annotated[
    str,
    typer.Option(
        metavar="'X,Y X,Y X,Y X,Y'",
        help="Corners of the chart's 24 patches in the picture, in turn; without it they are looked for.",
        show_default=False,
    ),
]
log = logging.getLogger(LOGGER_NAME)


def with_charts(given: Given, picture: str, corners: str) -> Given:
    """The capture with the corrections by `picture`, each told in a line; as it is without a picture."""
    if not picture:
        if corners:
            raise UsageError("--chart-corners: of what picture? give --colour-chart too")
        return given
    from facerf_cli.stage.chart.measure import read_charts

    try:
        charts = tuple(read_charts(given.opened(), picture, parse_corners(corners) if corners else None))
    except InputError as error:
        raise UsageError(f"--colour-chart: {error}") from None
    for chart in charts:
        log.info("%s", chart.in_words())
    return replace(given, charts=charts)


def parse_corners(text: str) -> "np.ndarray":
    """Four corners [4, 2] in pixels from `x,y x,y x,y x,y`."""
    import numpy as np

    try:
        corners_px = np.array([[float(number) for number in pair.split(",")] for pair in text.split()])
    except ValueError:
        corners_px = np.empty(0)
    if corners_px.shape != (4, 2) or not np.isfinite(corners_px).all():
        raise UsageError(f"--chart-corners '{text}': give four corners in pixels, as 'x,y x,y x,y x,y'")
    return corners_px
