"""`facerf prepare-dataset`: crops, fits, OLAT stacks and splits of a light stage's capture."""

from dataclasses import replace
from pathlib import Path
from typing import Annotated

import typer

from facerf_cli.batch.settings import BatchOptions
from facerf_cli.capture.settings import CAPTURE, ChartSettings, CheckSettings, ReadSettings
from facerf_cli.cli.options import refuse_given, settings_of
from facerf_cli.dataset.settings import DatasetSettings
from facerf_cli.errors import UsageError
from facerf_cli.option import Without

_DESCRIBES = ("capture", "output", "describe", "pattern", "dry_run")  # parameters that --describe uses


def prepare_dataset(
    context: typer.Context,
    capture: Annotated[
        Path,
        typer.Argument(
            metavar="CAPTURE",
            help="Folder of a capture, with stage.json or in another --layout.",
            show_default=False,
        ),
    ],
    reading: ReadSettings,
    chart: ChartSettings,
    checking: CheckSettings,
    content: DatasetSettings,
    batch: Annotated[BatchOptions, Without("output", "name")],
    output: Annotated[
        Path | None,
        typer.Option(
            "--output",
            "-o",
            metavar="DATASET",
            help="Folder of the dataset; with --describe, file of the draft.",
            show_default="CAPTURE/stage.json with --describe",
        ),
    ] = None,
    describe: Annotated[
        bool,
        typer.Option(
            "--describe",
            help="Only write a draft of stage.json from file names and headers, and list what to fill in.",
            rich_help_panel=CAPTURE,
        ),
    ] = False,
    pattern: Annotated[
        str,
        typer.Option(
            metavar="PATTERN",
            help="With --describe, pattern of image paths below CAPTURE, such as "
            "'{subject}/{camera}/{light}.exr'.",
            show_default=False,
            rich_help_panel=CAPTURE,
        ),
    ] = "",
) -> None:
    """Prepare a light stage's capture for training: crops, fits, OLAT stacks, splits.

    Frames are converted to linear Rec.709, the black level is subtracted, and each is divided by its light's
    intensity. One head is fitted to all cameras of a subject. DATASET gets olat/SUBJECT/CAMERA.exr (OLAT
    stacks for `facerf relight`), fits, a contact sheet per subject, index.html and finally dataset.json. A
    second run continues an interrupted one.

    A light whose frame is missing or broken in one camera is removed from that subject's stacks. A camera is
    removed if it lacks most frames, or if no face is found in it; dataset.json lists both. A subject with
    less than half of the lights, or fewer than 10, fails. findings.jsonl contains the results of the checks.
    """
    if describe:
        others = [name for name in context.params if name not in _DESCRIBES]
        refuse_given(context, others, "has no effect with --describe; remove it")
        from facerf_cli.capture.draft import describe_capture

        describe_capture(capture, pattern, output, batch.dry_run)
        return
    refuse_given(context, ["pattern"], "requires --describe; otherwise set the pattern in stage.json")
    if output is None:
        raise UsageError("-o: missing; pass -o DATASET, a folder, or --describe for a draft of stage.json")
    from facerf_cli.dataset.prepare_capture import prepare_capture

    batch = replace(batch, output=output)
    settings = settings_of(context)
    code = prepare_capture(capture, reading, chart, checking, content, batch, settings)
    raise typer.Exit(code)
