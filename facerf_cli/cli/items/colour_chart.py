"""The options --colour-chart and --chart-corners of `facerf prepare-dataset`.

`facerf prepare-dataset FOLDER --describe`: a first draft of stage.json, and what is left to a person.
"""

import logging
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from facerf_cli.cli.batch import PHOTO_SUFFIXES
from facerf_cli.cli.items.prepare_dataset import Given
from facerf_cli.cli.options import refuse_given
from facerf_cli.errors import InputError, UsageError
from facerf_cli.logs import LOGGER_NAME

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


def with_charts(given: Given, image: str, corners: str) -> Given:
    """The capture with the corrections by `picture`, each told in a line; as it is without a picture."""
    if not image:
        if corners:
            raise UsageError("--chart-corners: of what picture? give --colour-chart too")
        return given
    from facerf_cli.capture.colour_chart import read_charts

    try:
        charts = tuple(read_charts(given.opened(), image, parse_corners(corners) if corners else None))
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


_TAKEN = ("capture", "output", "describe", "dry_run")  # of the verb's arguments


def describe_capture(context: typer.Context, folder: Path, output: Path | None, dry_run: bool) -> None:
    """Write the draft to FOLDER/stage.json, or where `output` says, never over anything; print its path.

    A dry run tells the same and writes nothing. UsageError for options that are for preparing.
    """
    from facerf_cli.capture.draft import as_text, draft_stage
    from facerf_cli.capture.stage_json import STAGE_FILE
    from facerf_cli.files.atomic import atomic_path

    others = [name for name in context.params if name not in _TAKEN]
    refuse_given(context, others, "is for preparing; leave it out with --describe")
    path = folder / STAGE_FILE if output is None else output
    if path.is_dir():
        raise UsageError(f"-o {path}: is a folder; give the draft's name, such as {path / STAGE_FILE}")
    if path.exists() or path.is_symlink():
        raise UsageError(
            f"{path}: is there already, and a draft replaces nothing; move it, or give -o another name"
        )
    stage = draft_stage(folder, PHOTO_SUFFIXES)
    for note in stage["draft"]:
        log.info("%s", note)
    if dry_run:
        print(f"{folder} -> {path}")
        return
    with atomic_path(path) as temporary:
        temporary.write_text(as_text(stage), encoding="utf-8", errors="backslashreplace")
    print(path)
