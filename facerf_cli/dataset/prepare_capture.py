"""Check and prepare all subjects of a capture, for `facerf prepare-dataset`."""

import logging
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np

from facerf_cli.batch.inputs import Item
from facerf_cli.batch.journal import json_rows
from facerf_cli.batch.recipe import Recipe, require_same
from facerf_cli.batch.run import Job, Outcome, run_items, sums_up
from facerf_cli.batch.settings import BatchOptions, Settings, torch_device
from facerf_cli.capture.capture import Capture
from facerf_cli.capture.chart import read_charts
from facerf_cli.capture.checks.subject import check_subject
from facerf_cli.capture.findings import (
    FINDINGS_FILE,
    Finding,
    Selection,
    collect_findings,
    has_new_frames,
    keep_findings,
    require_sound,
    select_frames,
    show_findings,
    stopping,
    write_findings,
)
from facerf_cli.capture.layouts import read_capture
from facerf_cli.capture.settings import ChartSettings, CheckSettings, ReadSettings
from facerf_cli.dataset.dataset import (
    DATASET_FILE,
    LARGEST_CROP_PX,
    DatasetFolder,
    Split,
    SubjectRecord,
    describe_dataset,
    preparation,
)
from facerf_cli.dataset.pairs import GIVE_BEFORE, PAIRS_NAME, RELIT
from facerf_cli.dataset.prepare import (
    Preparation,
    prepare_subject,
    prepared_subjects,
    subject_outputs,
)
from facerf_cli.dataset.settings import DatasetSettings
from facerf_cli.errors import InputError, UsageError
from facerf_cli.face.fit import CROP_STEP_PX
from facerf_cli.face.morphable import BUILTIN, BUILTIN_PATH, load_face_model
from facerf_cli.files.atomic import atomic_path
from facerf_cli.files.documents import write_document
from facerf_cli.files.sheets import filled_page
from facerf_cli.files.texts import file_sha256
from facerf_cli.network.files import serving_files
from facerf_cli.relighting.models import Networks
from facerf_cli.run.logs import LOGGER_NAME, counted
from facerf_cli.run.workers import one_thread, process_died, spread

log = logging.getLogger(LOGGER_NAME)


def prepare_capture(
    folder: Path,
    reading: ReadSettings,
    chart: ChartSettings,
    checking: CheckSettings,
    content: DatasetSettings,
    batch: BatchOptions,
    settings: Settings,
) -> int:
    """Prepare all subjects of the capture in a folder, or only check them; return the exit code."""
    split, overwrite, output = Split.parse(content.split), batch.overwrite == "always", batch.output
    if (px := content.crop) is not None and (px % CROP_STEP_PX or not 0 < px <= LARGEST_CROP_PX):
        raise UsageError(f"--crop {px}: use a multiple of {CROP_STEP_PX} up to {LARGEST_CROP_PX}")
    capture = _open_capture(folder, reading, chart)
    _check_subjects(capture, output, split)
    items = [Item(capture.folder / name, output / name, name) for name in capture.subjects]
    if checking.checks == "only" and not batch.dry_run:
        return _check_all(capture, items, batch, checking.strict, settings)
    networks = Networks(serving_files(settings.checkpoints, user="facerf"), torch_device(settings))
    model, is_builtin = load_face_model(content.face_model), content.face_model == BUILTIN
    model_sha256 = file_sha256(BUILTIN_PATH if is_builtin else Path(content.face_model))
    made_from = preparation(capture, model_sha256, content.crop, networks.sha256("parsing"))
    how = Preparation(model, networks, DatasetFolder(folder=output), content.crop, made_from, checking.strict)
    if not overwrite:
        _judge_earlier(capture, output, made_from, batch.dry_run)
    elif not batch.dry_run:
        (output / DATASET_FILE).unlink(missing_ok=True)  # its subjects are about to be replaced
    work = Prepare(capture, how, checking.checks == "on")
    code = run_items(work, items, batch, settings)
    if not batch.dry_run and sums_up(items, work.outputs_of, batch):
        _write_dataset(capture, how, split, settings.seed, model_sha256)
    return code


def _check_all(
    capture: Capture, items: Sequence[Item], batch: BatchOptions, strict: bool, settings: Settings
) -> int:
    """Check all subjects, print the table and write findings.jsonl; return 1 if a subject would be stopped.

    UsageError with `--shard`, because the file covers all subjects.
    """
    work = partial(_check, capture)
    if batch.shard.of > 1:
        raise UsageError("--shard: --checks only checks all subjects; use --jobs or --ray instead")
    results = spread(work, items, batch.workers(settings), _not_checked, "checks")
    findings = [finding for of_subject in results for finding in of_subject]
    write_findings(batch.output / FINDINGS_FILE, findings)
    show_findings(findings, strict)
    if not findings:
        log.info("checked: %s, nothing found", counted(len(items), "subject"))
    print(batch.output / FINDINGS_FILE)
    return 1 if stopping(findings, strict) else 0


def _check(capture: Capture, item: Item) -> list[Finding]:
    with one_thread():
        return check_subject(capture, item.name)


def _not_checked(item: Item, error: Exception) -> list[Finding]:
    return [Finding("error", "unchecked", item.name, process_died(error))]


def _open_capture(folder: Path, reading: ReadSettings, chart: ChartSettings) -> Capture:
    """Read a capture's description and --colour-chart, and log the corrections."""
    image, corners = chart.colour_chart, chart.chart_corners
    if bool(corners) != bool(image):
        raise UsageError(
            "--colour-chart, --chart-corners: one is missing; pass the image and its chart's corners"
        )
    try:
        capture = read_capture(folder, reading)
    except InputError as error:
        raise UsageError(str(error)) from None
    try:
        charts = tuple(read_charts(capture, image, list(_parse_corners(corners)))) if image else ()
    except InputError as error:
        raise UsageError(f"--colour-chart: {error}") from None
    for correction in charts:
        log.info("%s", correction.in_words())
    return replace(capture, charts=charts)


def _parse_corners(text: str) -> np.ndarray:
    """Parse four corners [N, 4, 2] in pixels for each of N images, `x,y x,y x,y x,y; x,y ...`."""
    try:
        corners_px = np.array(
            [
                [[float(number) for number in pair.split(",")] for pair in of_image.split()]
                for of_image in text.split(";")
            ]
        )
    except ValueError:
        corners_px = np.empty(0)
    if corners_px.shape[1:] != (4, 2) or not np.isfinite(corners_px).all():
        raise UsageError(f"--chart-corners '{text}': use four corners in pixels, as 'x,y x,y x,y x,y'")
    return corners_px


def _check_subjects(capture: Capture, output: Path, split: Split) -> None:
    """Raise UsageError for faults that concern all subjects; log what the options leave out."""
    if not capture.subjects:
        raise UsageError(
            f"{capture.folder}: no subjects found at {capture.pattern}; check the pattern and the images"
        )
    if output.resolve() == capture.folder.resolve():
        raise UsageError(f"-o {output}: the folder of the capture itself; use another folder")
    if marked := sum(map(len, capture.marked.values())):
        log.info("%s: left out %d images that are marked as damaged (.bad)", capture.folder, marked)
    left = len(capture.subjects) - sum(split.counts(len(capture.subjects)))
    if left:
        log.warning("--split leaves %d of %d subjects out of every split", left, len(capture.subjects))


def _judge_earlier(capture: Capture, output: Path, made_from: Recipe, dry_run: bool) -> None:
    """Raise UsageError if finished subjects were prepared with other options.

    Removes the records of subjects whose missing frames exist now, so that they are prepared again.
    """
    dataset = DatasetFolder(folder=output)
    earlier = prepared_subjects(capture, dataset)
    for subject, record in earlier.items():
        advice = "pass --overwrite always to prepare all subjects again, or another folder with -o"
        require_same(record.prepared, made_from, f"{output}: {subject} was prepared otherwise", advice)
    for subject, record in () if dry_run else earlier.items():
        if has_new_frames(capture, subject, record.missing):
            log.info("%s: missing frames exist now; preparing the subject again", subject)
            dataset.record_path(subject).unlink()


@dataclass(frozen=True)
class Prepare(Job):
    """Job that prepares one subject."""

    verb = "prepare-dataset"

    capture: Capture
    how: Preparation
    with_checks: bool

    def outputs_of(self, item: Item) -> Sequence[Path]:
        """Return the files of a subject."""
        return subject_outputs(self.capture, item.name, self.how.dataset)

    def __call__(self, item: Item) -> Outcome:
        """Prepare a subject on one thread, so that its bytes do not depend on the number of cores."""
        with one_thread():
            chosen = self._choose(item.name)
            record = prepare_subject(self.capture, item.name, chosen, self.how)
        if record.quality == "poor":
            log.warning("%s: the fit is poor; check sheets/%s.jpg", item.input_path, item.name)
        facts = record.model_dump(include={"error_iod", "quality", "faces_found"})
        facts |= {"cameras": len(record.cameras), "lights": len(chosen.lights)}
        facts |= {"worst_crop_off_iod": max(camera.crop_off_iod for camera in record.cameras.values())}
        return Outcome(self.outputs_of(item), facts)

    def _choose(self, subject: str) -> Selection:
        """Check a subject and select its sound frames; InputError for too few."""
        capture, strict = self.capture, self.how.strict
        findings = check_subject(capture, subject) if self.with_checks else []
        keep_findings(self.how.dataset.folder, subject, findings)
        require_sound(subject, findings, strict)
        return select_frames(capture, subject, findings, strict)


def _write_dataset(
    capture: Capture, how: Preparation, split: Split, seed: int, face_model_sha256: str
) -> None:
    """Write findings.jsonl, the index page and dataset.json of the subjects prepared with these options."""
    folder = how.dataset.folder
    records: dict[str, SubjectRecord] = {
        subject: record
        for subject, record in prepared_subjects(capture, how.dataset).items()
        if record.prepared == how.made_from
    }
    findings = collect_findings(folder, capture.subjects)
    show_findings([finding for of_subject in findings.values() for finding in of_subject], how.strict)
    if not records:
        return
    dataset = describe_dataset(folder, capture, records, split, seed, how.model, face_model_sha256)
    with atomic_path(folder / "index.html") as temporary:
        page = {"dataset": dataset, "records": records, "findings": findings, "split_of": dataset.split_of}
        text = filled_page(Path(__file__).with_name("index.html"), **page)
        temporary.write_text(text, encoding="utf-8", errors="replace")  # folder names may be any bytes
    write_document(folder / DATASET_FILE, dataset.content())
    print(folder / DATASET_FILE)
    pairs = json_rows(folder / RELIT / PAIRS_NAME)
    if moved := {
        row.get("subject") for row in pairs if dataset.split_of(str(row.get("subject"))) != row.get("split")
    }:
        words = "%s: the pairs of %d subjects belong to another split; %s"
        log.warning(words, folder / RELIT, len(moved), GIVE_BEFORE)
