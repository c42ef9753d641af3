"""`facerf prepare-dataset`: a light stage's capture as crops, fits, OLAT stacks and splits."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import typer

from facerf_cli.cli.options import (
    DryRunOption,
    FaceModelOption,
    JobsOption,
    Overwrite,
    OverwriteOption,
    refuse_given,
    settings_of,
)
from facerf_cli.errors import UsageError

_CAPTURE, _CORRECTION, _DATASET = "Capture", "Checks and corrections", "Dataset"
Checks = Literal["on", "off", "only"]
_DESCRIBES = ("capture", "output", "describe", "pattern", "dry_run")  # parameters that --describe uses


@dataclass(frozen=True)
class PrepareOptions:
    """The options of a preparation."""

    capture: Path
    layout: str
    subtract_ambient: bool
    align: bool
    colour_chart: str  # empty: none
    chart_corners: str  # empty: search for the chart
    checks: Checks
    strict: bool
    split: str
    crop_px: int | None  # None: 256, nothing enlarged
    face_model: str
    overwrite: Overwrite
    dry_run: bool
    jobs: int


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
    output: Annotated[
        Path | None,
        typer.Option(
            "--output",
            "-o",
            metavar="DATASET",
            help="Write the dataset to this folder; with --describe, the draft to this file.",
            show_default="CAPTURE/stage.json with --describe",
        ),
    ] = None,
    describe: Annotated[
        bool,
        typer.Option(
            "--describe",
            help="Write a first draft of stage.json from file names and headers, list what to fill in, and "
            "prepare nothing.",
            rich_help_panel=_CAPTURE,
        ),
    ] = False,
    pattern: Annotated[
        str,
        typer.Option(
            metavar="PATTERN",
            help="With --describe, find the images by this path below CAPTURE, such as "
            "'{subject}/{camera}/{light}.exr'.",
            show_default="by folder depth",
            rich_help_panel=_CAPTURE,
        ),
    ] = "",
    layout: Annotated[
        str,
        typer.Option(
            metavar="NAME",
            help="Read this layout of a capture: stage (with stage.json), or extended-yale-b (that database, "
            "cropped, as distributed).",
            rich_help_panel=_CAPTURE,
        ),
    ] = "stage",
    subtract_ambient: Annotated[
        bool,
        typer.Option(
            "--subtract-ambient",
            help="Subtract each camera's image without lights, where there is one.",
            rich_help_panel=_CORRECTION,
        ),
    ] = False,
    align: Annotated[
        bool,
        typer.Option(
            "--align",
            help="Shift frames in which the head has moved back to its place.",
            rich_help_panel=_CORRECTION,
        ),
    ] = False,
    colour_chart: Annotated[
        str,
        typer.Option(
            metavar="IMAGE",
            help="Correct the colours by this image of a ColorChecker Classic under the stage's lights; with "
            "{camera} in its name, by an image per camera.",
            show_default=False,
            rich_help_panel=_CORRECTION,
        ),
    ] = "",
    chart_corners: Annotated[
        str,
        typer.Option(
            metavar="'X,Y X,Y X,Y X,Y'",
            help="Corners of the chart's 24 patches in pixels, in order around them.",
            show_default="search for the chart",
            rich_help_panel=_CORRECTION,
        ),
    ] = "",
    checks: Annotated[
        Checks,
        typer.Option(
            help="Check the frames first: broken frames are left out, errors stop a subject. only: list the "
            "findings, and prepare nothing.",
            rich_help_panel=_CORRECTION,
        ),
    ] = "on",
    strict: Annotated[
        bool,
        typer.Option(
            "--strict",
            help="Stop a subject for any finding, missing frame or undetected face.",
            rich_help_panel=_CORRECTION,
        ),
    ] = False,
    split: Annotated[
        str,
        typer.Option(
            metavar="T/V/T",
            help="Split the subjects into training, validation and test: counts (300/10/40) or shares, drawn "
            "by --seed.",
            rich_help_panel=_DATASET,
        ),
    ] = "0.8/0.1/0.1",
    crop: Annotated[
        int | None,
        typer.Option(
            metavar="PX",
            help="Write crops of this side, a multiple of 8.",
            show_default="256, or less where the face has fewer pixels",
            rich_help_panel=_DATASET,
        ),
    ] = None,
    face_model: FaceModelOption = "builtin",
    overwrite: OverwriteOption = "changed",
    dry_run: DryRunOption = False,
    jobs: JobsOption = 1,
) -> None:
    """Prepare a light stage's capture for training: crops, fits, OLAT stacks, splits.

    Frames are converted to linear Rec.709, less the black level, and divided by each light's intensity. One
    head is fitted to all cameras of a subject. DATASET gets olat/SUBJECT/CAMERA.exr (OLAT stacks for `facerf
    relight`), fits, a contact sheet per subject, index.html, and dataset.json at the end. A second run
    continues an interrupted one.

    A light whose frame is missing or broken in one camera is left out of that subject's stacks. A camera that
    lacks most frames, or in which no face is found, is left out, too; dataset.json lists both. A subject with
    less than half of the lights, or fewer than 10, fails. findings.jsonl has the findings of the checks.
    """
    from facerf_cli.cli.items.prepare_capture import describe_capture, prepare_capture

    if describe:
        others = [name for name in context.params if name not in _DESCRIBES]
        refuse_given(context, others, "is for preparing; leave it out with --describe")
        describe_capture(capture, pattern, output, dry_run)
        return
    refuse_given(context, ["pattern"], "is for --describe; leave it out, stage.json has the pattern")
    if output is None:
        raise UsageError(
            "-o: is missing; give -o DATASET, a folder (or --describe, for a draft of stage.json)"
        )
    options = PrepareOptions(
        capture,
        layout,
        subtract_ambient,
        align,
        colour_chart,
        chart_corners,
        checks,
        strict,
        split,
        crop,
        face_model,
        overwrite,
        dry_run,
        jobs,
    )
    raise typer.Exit(prepare_capture(options, output, settings_of(context)))
