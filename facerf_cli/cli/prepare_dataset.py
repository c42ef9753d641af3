"""`facerf prepare-dataset`: a light stage's capture as crops, fits, OLAT stacks and splits."""

import logging
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from facerf_cli.cli.batch import BatchOptions, Item, run_items, sums_up
from facerf_cli.cli.items.colour_chart import (
    ChartCornersOption,
    ColourChartOption,
    describe_capture,
    with_charts,
)
from facerf_cli.cli.items.prepare_dataset import (
    CheckOnly,
    Checks,
    Given,
    Prepare,
    check_all,
    collect_findings,
    face_model_of,
    show_findings,
)
from facerf_cli.cli.options import DryRunOption, FaceModelOption, OverwriteOption, settings_of
from facerf_cli.errors import UsageError
from facerf_cli.logs import LOGGER_NAME

if TYPE_CHECKING:
    from facerf_cli.capture.capture import Capture
    from facerf_cli.dataset.dataset import Split

_CROP_STEP_PX = 8
log = logging.getLogger(LOGGER_NAME)


def prepare_dataset(
    context: typer.Context,
    capture: Annotated[
        Path,
        typer.Argument(
            metavar="CAPTURE", help="Folder with stage.json, or as --layout says.", show_default=False
        ),
    ],
    output: Annotated[
        Path | None,
        typer.Option(
            "--output",
            "-o",
            metavar="DATASET",
            help="Folder for the data; with --describe the draft's name.",
            show_default="CAPTURE/stage.json with --describe",
        ),
    ] = None,
    describe: Annotated[
        bool,
        typer.Option(
            "--describe",
            help="Write a first draft of stage.json by the pictures' names and headers, tell what is left to "
            "fill in, and prepare nothing.",
        ),
    ] = False,
    layout: Annotated[
        str,
        typer.Option(
            metavar="NAME",
            help="How the capture lies on disk: stage (with stage.json), or extended-yale-b (that database, "
            "cropped, as it is distributed).",
        ),
    ] = "stage",
    subtract_ambient: Annotated[
        bool,
        typer.Option("--subtract-ambient", help="Subtract each camera's picture without lamps, if there."),
    ] = False,
    align: Annotated[
        bool, typer.Option("--align", help="Shift frames back to where the head was, where it moved.")
    ] = False,
    colour_chart: ColourChartOption = "",
    chart_corners: ChartCornersOption = "",
    checks: Annotated[
        Checks,
        typer.Option(
            help="Look for faults in the frames first: broken frames are left out, errors stop a subject. "
            "only: tell what is found, and prepare nothing.",
        ),
    ] = "on",
    strict: Annotated[
        bool, typer.Option("--strict", help="Any finding, missing frame or unseen face stops its subject.")
    ] = False,
    split: Annotated[
        str,
        typer.Option(
            metavar="T/V/T",
            help="Subjects for training, validation and test: counts (300/10/40) or shares; --seed draws.",
        ),
    ] = "0.8/0.1/0.1",
    crop: Annotated[int, typer.Option(metavar="PX", help="Side of the crops; a multiple of 8.")] = 256,
    face_model: FaceModelOption = "builtin",
    overwrite: OverwriteOption = False,
    dry_run: DryRunOption = False,
    jobs: Annotated[int, typer.Option("--jobs", "-j", min=1, help="Subjects worked on at a time.")] = 1,
) -> None:
    """Prepare a light stage's capture for training: crops, fits, OLAT stacks, splits.

    Pictures are taken to linear Rec.709, less the black level, over each lamp's intensity. One head is fitted
    to all of a subject's cameras; DATASET gets olat/SUBJECT/CAMERA.exr (stacks that `facerf relight` takes),
    fits, a sheet a subject, index.html to look through, and dataset.json at the end. A second run goes on
    where the first was cut off.

    A light whose frame is missing or broken in one camera is left out of that subject's stacks, a camera that
    lacks most frames or does not see the face is left out, and dataset.json says so; with less than half of
    the lights left, or less than 10, a subject fails. findings.jsonl has what the checks found.
    """
    from facerf_cli.dataset.dataset import DATASET_FILE, LARGEST_CROP_PX, Split, preparation_key

    if describe:
        describe_capture(context, capture, output, dry_run)
        return
    if output is None:
        raise UsageError("give -o DATASET, a folder for the data (or --describe, for a draft of stage.json)")
    settings = settings_of(context)
    drawn = Split.parse(split)
    if crop % _CROP_STEP_PX or not 0 < crop <= LARGEST_CROP_PX:
        raise UsageError(f"--crop {crop}: give a multiple of {_CROP_STEP_PX} up to {LARGEST_CROP_PX}")
    given = with_charts(Given(capture, layout, subtract_ambient, align), colour_chart, chart_corners)
    found = given.opened()
    _check_subjects(found, output, drawn)
    items = [Item(found.folder / name, output / name, name) for name in found.subjects]
    if checks == "only" and not dry_run:
        raise typer.Exit(check_all(CheckOnly(given.opened), items, output, jobs, strict, settings))
    model_sha256 = _model_digest(face_model)
    key = preparation_key(found, model_sha256, crop)
    _check_earlier(found, output, key, overwrite)
    work = Prepare(given, checks, strict, face_model, crop, output, key)
    options = BatchOptions(output, overwrite, dry_run, jobs)
    if overwrite and not dry_run:
        (output / DATASET_FILE).unlink(missing_ok=True)  # it speaks of what is about to go
    elif not dry_run:
        _forget_mended(found, output)
    code = run_items("prepare-dataset", items, work, work.outputs_of, options, settings)
    if not dry_run and sums_up(items, work.outputs_of, options, settings):
        _finish(work, found, drawn, settings.seed, model_sha256)
    raise typer.Exit(code)


def _check_subjects(capture: "Capture", output: Path, split: "Split") -> None:
    """Raise for what no subject could mend."""
    if not capture.subjects:
        raise UsageError(f"{capture.folder}: no subjects found (pictures are at {capture.pattern})")
    if output.resolve() == capture.folder.resolve():
        raise UsageError(f"-o {output}: is the capture itself; give another folder")
    if marked := sum(map(len, capture.marked.values())):
        log.info("%s: %d pictures that are marked as damaged (.bad) are left out", capture.folder, marked)
    left = len(capture.subjects) - sum(split.counts(len(capture.subjects)))
    if left:
        log.warning("--split leaves %d of %d subjects out of every split", left, len(capture.subjects))


def _model_digest(name: str) -> str:
    from facerf_cli.dataset.dataset import sha256_of
    from facerf_cli.face.morphable import BUILTIN, BUILTIN_PATH

    face_model_of(name)  # a file that is none is named first
    return sha256_of(BUILTIN_PATH if name == BUILTIN else Path(name))


def _check_earlier(capture: "Capture", output: Path, key: str, overwrite: bool) -> None:
    """Raise where finished subjects were prepared otherwise: a dataset is of one kind."""
    from facerf_cli.dataset.prepare import prepared_subjects

    earlier = {} if overwrite else prepared_subjects(capture, output)
    other = [subject for subject, record in earlier.items() if record.get("prepared") != key]
    if other:
        raise UsageError(
            f"{output}: {len(other)} subjects ({other[0]}, ...) were prepared with another crop, face model, "
            "calibration or colour chart; give --overwrite, or another folder"
        )


def _show_charts(capture: "Capture", output: Path) -> None:
    """Write pictures of the colour charts, so that a person sees what was sampled; older ones go."""
    for older in output.glob("colour_chart*.png"):
        older.unlink()
    if capture.charts:
        from facerf_cli.capture.colour_chart import write_chart_overlays

        write_chart_overlays(capture, output)


def _forget_mended(capture: "Capture", output: Path) -> None:
    """Have the subjects made anew that lacked frames which have come since."""
    from facerf_cli.capture.select import is_mended
    from facerf_cli.dataset.dataset import record_path
    from facerf_cli.dataset.prepare import prepared_subjects

    for subject, record in prepared_subjects(capture, output).items():
        if is_mended(capture, subject, record.get("missing", ())):
            log.info("%s: frames that it lacked are there now; it is made anew", subject)
            record_path(output, subject).unlink()


def _finish(work: Prepare, capture: "Capture", split: "Split", seed: int, model_sha256: str) -> None:
    """Write the page and `dataset.json` of the subjects that are finished, and prepared as this run would."""
    from facerf_cli.dataset.dataset import DATASET_FILE, describe_dataset
    from facerf_cli.dataset.pages import index_page
    from facerf_cli.dataset.prepare import prepared_subjects
    from facerf_cli.files.atomic import atomic_path
    from facerf_cli.files.documents import write_document

    found = prepared_subjects(capture, work.folder).items()
    records = {subject: record for subject, record in found if record.get("prepared") == work.key}
    findings = collect_findings(work.folder, capture.subjects)
    show_findings([row for rows in findings.values() for row in rows], work.strict)
    if not records:
        return
    _show_charts(capture, work.folder)
    model = face_model_of(work.face_model)
    dataset = describe_dataset(capture, records, split, seed, model, model_sha256, work.crop_px)
    with atomic_path(work.folder / "index.html") as temporary:
        text = index_page(dataset, records, findings)
        temporary.write_text(
            text, encoding="utf-8", errors="replace"
        )  # folders may have any bytes for a name
    write_document(work.folder / DATASET_FILE, dataset)
    print(work.folder / DATASET_FILE)
