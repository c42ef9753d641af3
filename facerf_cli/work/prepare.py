"""Work of `facerf prepare-dataset`: draft a stage.json, or check and prepare the subjects of a capture."""

import logging
import os
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from rich.progress import track

from facerf_cli.batch.inputs import PHOTO_SUFFIXES, Item, collect_items
from facerf_cli.batch.made_from import Recipe, json_rows, require_same
from facerf_cli.batch.run import BatchOptions, Outcome, run_items, sums_up
from facerf_cli.batch.settings import Settings, torch_device
from facerf_cli.capture.capture import Capture
from facerf_cli.capture.chart_photo import read_charts, write_chart_overlays
from facerf_cli.capture.checks.motion import with_alignment
from facerf_cli.capture.checks.subject import check_subject
from facerf_cli.capture.draft import as_text, draft_stage
from facerf_cli.capture.findings import (
    Finding,
    Selection,
    frames_left_out,
    has_new_frames,
    select_frames,
    stopping,
)
from facerf_cli.capture.settings import ChartSettings, CheckSettings, ReadSettings
from facerf_cli.capture.stage_json import STAGE_FILE, read_capture
from facerf_cli.dataset.cost import cost_of_sources, in_words, recipe_bytes
from facerf_cli.dataset.dataset import (
    DATASET_FILE,
    LARGEST_CROP_PX,
    Dataset,
    DatasetFolder,
    Split,
    describe_dataset,
    preparation,
    read_dataset,
)
from facerf_cli.dataset.pairs import (
    GIVE_BEFORE,
    PAIRS_NAME,
    RELIT,
    Pair,
    draw_pairs,
    image_path,
    load_pairs,
    pairs_path,
    relight_subject,
    write_pairs,
)
from facerf_cli.dataset.prepare import (
    Preparation,
    index_page,
    prepare_subject,
    prepared_subjects,
    subject_outputs,
)
from facerf_cli.dataset.settings import DatasetSettings, PairSettings
from facerf_cli.dataset.weights import envmap_names
from facerf_cli.errors import InputError, UsageError
from facerf_cli.face.joint_fit import CROP_STEP_PX
from facerf_cli.face.morphable import BUILTIN, BUILTIN_PATH, load_face_model
from facerf_cli.files.atomic import atomic_path
from facerf_cli.files.documents import write_document
from facerf_cli.files.texts import file_sha256
from facerf_cli.network.files import serving_files
from facerf_cli.relighting.models import Networks
from facerf_cli.run import memory
from facerf_cli.run.logs import LOGGER_NAME, STDERR, counted
from facerf_cli.run.workers import one_thread, process_died, spread
from facerf_cli.synth.sky.skies import parse_envmaps
from facerf_cli.work.capture_findings import (
    FINDINGS_FILE,
    collect_findings,
    keep_findings,
    require_sound,
    show_findings,
    write_findings,
)
from facerf_cli.work.light_setups import MAP_SUFFIXES

T = TypeVar("T")
R = TypeVar("R")
_DRAWN = "procedural:"
_TEST_MAPS_OF = 10  # one in so many maps is for the split test alone
log = logging.getLogger(LOGGER_NAME)


def describe_capture(folder: Path, pattern: str, output: Path | None, dry_run: bool) -> None:
    """Write a draft of stage.json to `output` or into the folder, and print its path and notes.

    UsageError where the file exists. A dry run prints the notes only.
    """
    path = folder / STAGE_FILE if output is None else output
    if path.is_dir() and not dry_run:
        raise UsageError(f"-o {path}: is a folder; give the draft's name, such as {path / STAGE_FILE}")
    if not dry_run and (path.exists() or path.is_symlink()):
        raise UsageError(
            f"{path}: is there already, and a draft replaces nothing; move it, or give -o another name"
        )
    stage = draft_stage(folder, PHOTO_SUFFIXES, pattern)
    for note in stage["draft"]:
        log.info("%s", note)
    if dry_run:
        print(f"{folder} -> {path}")
        return
    with atomic_path(path) as temporary:
        temporary.write_text(as_text(stage), encoding="utf-8", errors="backslashreplace")
    print(path)


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
        raise UsageError(f"--crop {px}: give a multiple of {CROP_STEP_PX} up to {LARGEST_CROP_PX}")
    capture = _open_capture(folder, reading, chart)
    _check_subjects(capture, output, split)
    items = [Item(capture.folder / name, output / name, name) for name in capture.subjects]
    if checking.checks == "only" and not batch.dry_run:
        return check_all(partial(_check, capture), items, batch, checking.strict, settings)
    networks = Networks(serving_files(settings.checkpoints, user="facerf"), torch_device(settings))
    model, is_builtin = load_face_model(content.face_model), content.face_model == BUILTIN
    model_sha256 = file_sha256(BUILTIN_PATH if is_builtin else Path(content.face_model))
    made_from = preparation(capture, model_sha256, content.crop, networks.sha256("parsing"))
    how = Preparation(model, networks, DatasetFolder(output), content.crop, made_from, checking.strict)
    if not overwrite:
        _judge_earlier(capture, output, made_from, batch.dry_run)
    elif not batch.dry_run:
        (output / DATASET_FILE).unlink(missing_ok=True)  # its subjects are about to be replaced
    work = Prepare(capture, how, checking.checks == "on")
    code = run_items("prepare-dataset", items, work, work.outputs_of, batch, settings)
    if not batch.dry_run and sums_up(items, work.outputs_of, batch):
        _write_dataset(capture, how, split, settings.seed, model_sha256)
    return code


def check_all(
    work: Callable[[Item], list[Finding]],
    items: Sequence[Item],
    batch: BatchOptions,
    strict: bool,
    settings: Settings,
) -> int:
    """Check all subjects, print the table and write findings.jsonl; return 1 if a subject would be stopped.

    UsageError with `--shard`, because the file covers all subjects.
    """
    if batch.shard.of > 1:
        raise UsageError("--shard: --checks only checks all subjects; omit it, and give --jobs or --ray")
    results = with_bar(work, items, "checks", batch, settings, _not_checked)
    findings = [found for of_subject in results for found in of_subject]
    write_findings(batch.output / FINDINGS_FILE, findings)
    show_findings(findings, strict)
    if not findings:
        log.info("checked: %s, nothing found", counted(len(items), "subject"))
    print(batch.output / FINDINGS_FILE)
    return 1 if stopping(findings, strict) else 0


def with_bar(
    work: Callable[[T], R],
    items: Sequence[T],
    title: str,
    batch: BatchOptions,
    settings: Settings,
    died: Callable[[T, Exception], R],
) -> Iterator[R]:
    """Map items by the workers of --jobs or --ray, with a progress bar."""
    shown = STDERR.is_terminal and settings.verbosity >= 0 and not settings.log_json
    results = spread(work, items, batch.workers(settings), died)
    return iter(track(results, title, len(items), console=STDERR, transient=True, disable=not shown))


def _check(capture: Capture, item: Item) -> list[Finding]:
    with one_thread():
        return check_subject(capture, item.name)


def _not_checked(item: Item, error: Exception) -> list[Finding]:
    return [Finding("error", "unchecked", item.name, process_died(error))]


def _open_capture(folder: Path, reading: ReadSettings, chart: ChartSettings) -> Capture:
    """Read a capture's description and --colour-chart, and log the corrections; UsageError for wrong ones."""
    image, corners = chart.colour_chart, chart.chart_corners
    if bool(corners) != bool(image):
        raise UsageError(
            "--colour-chart, --chart-corners: one is missing; give the image and its chart's corners"
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
        raise UsageError(f"--chart-corners '{text}': give four corners in pixels, as 'x,y x,y x,y x,y'")
    return corners_px


def _check_subjects(capture: Capture, output: Path, split: Split) -> None:
    """Raise for faults that concern all subjects; log what the options leave out."""
    if not capture.subjects:
        raise UsageError(
            f"{capture.folder}: no subjects found at {capture.pattern}; check the pattern and the images"
        )
    if output.resolve() == capture.folder.resolve():
        raise UsageError(f"-o {output}: is the capture itself; give another folder")
    if marked := sum(map(len, capture.marked.values())):
        log.info("%s: %d images that are marked as damaged (.bad) are left out", capture.folder, marked)
    left = len(capture.subjects) - sum(split.counts(len(capture.subjects)))
    if left:
        log.warning("--split leaves %d of %d subjects out of every split", left, len(capture.subjects))


def _judge_earlier(capture: Capture, output: Path, made_from: Recipe, dry_run: bool) -> None:
    """Raise UsageError where finished subjects were prepared with other options than this run has.

    Removes the records of subjects whose missing frames exist by now, so that they are prepared again.
    """
    dataset = DatasetFolder(output)
    earlier = prepared_subjects(capture, dataset)
    for subject, record in earlier.items():
        before, said = record.get("prepared"), f"{output}: {subject} was prepared otherwise"
        advice = "give --overwrite always to prepare all subjects again, or another folder with -o"
        require_same(before if isinstance(before, dict) else {}, made_from, said, advice)
    for subject, record in () if dry_run else earlier.items():
        if has_new_frames(capture, subject, record.get("missing", ())):
            log.info("%s: frames that were missing exist now; it is prepared again", subject)
            dataset.record_path(subject).unlink()


@dataclass(frozen=True)
class Prepare:
    """Prepares one subject; settings only."""

    capture: Capture
    how: Preparation
    with_checks: bool

    def outputs_of(self, item: Item) -> Sequence[Path]:
        """Files of a subject."""
        return subject_outputs(self.capture, item.name, self.how.dataset)

    def __call__(self, item: Item) -> Outcome:
        """Prepare a subject on one thread, so that its bytes do not depend on the number of cores."""
        with one_thread():
            capture, chosen = self._choose(item.name)
            record = prepare_subject(capture, item.name, chosen, self.how)
        if record["quality"] == "poor":
            log.warning("%s: the fit is poor; look at sheets/%s.jpg", item.input_path, item.name)
        worst = max(entry["crop_off_iod"] for entry in record["cameras"].values())
        facts = {name: record[name] for name in ("error_iod", "quality", "faces_found")}
        facts |= {"cameras": len(record["cameras"]), "worst_crop_off_iod": worst}
        facts |= {"lights": len(chosen.lights)}
        return Outcome(self.outputs_of(item), facts)

    def _choose(self, subject: str) -> tuple[Capture, Selection]:
        """Check a subject, select its sound frames, and align them on request; InputError for too few."""
        capture, strict = self.capture, self.how.strict
        findings = check_subject(capture, subject) if self.with_checks else []
        keep_findings(self.how.dataset.folder, subject, findings)
        require_sound(subject, findings, strict)
        chosen = select_frames(capture, subject, findings, strict)
        if capture.align:
            capture = with_alignment(capture, subject, frames_left_out(findings))
        return capture, chosen


def _write_dataset(
    capture: Capture, how: Preparation, split: Split, seed: int, face_model_sha256: str
) -> None:
    """Write findings.jsonl, the index page and dataset.json of the subjects prepared with these options."""
    folder, found = how.dataset.folder, prepared_subjects(capture, how.dataset).items()
    records = {subject: record for subject, record in found if record.get("prepared") == how.made_from}
    findings = collect_findings(folder, capture.subjects)
    show_findings([found for of_subject in findings.values() for found in of_subject], how.strict)
    if not records:
        return
    for older in folder.glob("colour_chart*.png"):
        older.unlink()
    write_chart_overlays(capture, folder)
    dataset = describe_dataset(capture, records, split, seed, how.model, face_model_sha256)
    with atomic_path(folder / "index.html") as temporary:
        text = index_page(dataset, records, findings)
        temporary.write_text(text, encoding="utf-8", errors="replace")  # folder names may be any bytes
    write_document(folder / DATASET_FILE, dataset)
    print(folder / DATASET_FILE)
    split_of = {subject: name for name, members in dataset["splits"].items() for subject in members}
    pairs = json_rows(folder / RELIT / PAIRS_NAME)
    if moved := {row.get("subject") for row in pairs if split_of.get(row.get("subject")) != row.get("split")}:
        words = "%s: the pairs of %d subjects are of another split; %s"
        log.warning(words, folder / RELIT, len(moved), GIVE_BEFORE)


def relight_subjects(folder: Path, wanted: PairSettings, batch: BatchOptions, settings: Settings) -> int:
    """Write the pairs and, unless lazy, the sources of the dataset in a folder; return the exit code."""
    dataset, overwrite = read_dataset(folder), batch.overwrite == "always"
    maps, test_maps = _maps_of_splits(dataset, wanted, batch.output, settings.seed)
    pairs = draw_pairs(dataset, maps, wanted.per_subject, settings.seed, test_maps)
    if not pairs:
        raise UsageError(f"{folder}: no subject is in a split; run prepare-dataset with another --split")
    if batch.dry_run:
        _say_cost(dataset, pairs, wanted.lazy, overwrite)
    else:
        write_pairs(dataset, pairs, overwrite, partial(_spread_maps, batch, settings))
        if test_maps != maps:
            log.info("maps: %d, and %d others for the split test alone", len(maps), len(test_maps))
    if wanted.lazy:
        print(pairs_path(dataset))
        return 0
    work = _Relight(dataset, wanted.per_subject, overwrite)
    subjects = dict.fromkeys(pair.subject for pair in pairs)
    items = [Item(folder / "olat" / name, batch.output / name, name) for name in subjects]
    return run_items("relight-dataset", items, work, work.outputs_of, batch, settings)


def _say_cost(dataset: Dataset, pairs: list[Pair], lazy: bool, overwrite: bool) -> None:
    """Log what the pairs and the sources that are missing will take."""
    log.info("%d recipes with their weights: %s", len(pairs), in_words(recipe_bytes(dataset, pairs)))
    if not lazy:
        todo = [pair for pair in pairs if overwrite or not image_path(dataset, *pair.key).exists()]
        log.info("%d sources of %d px: %s", len(todo), dataset.crop_px, cost_of_sources(dataset, todo))


def _maps_of_splits(
    dataset: Dataset, wanted: PairSettings, output: Path, seed: int
) -> tuple[list[str], list[str]]:
    """Names of the maps of training and validation, and those of the test; UsageError where they share one.

    Drawn maps of the test follow those of --envmaps in their sequence.
    """
    maps = _envmap_names("--envmaps", wanted.envmaps, output, seed)
    if wanted.envmaps_test is not None:
        drawn = len(maps) if wanted.envmaps.startswith(_DRAWN) else 0
        test_maps = _envmap_names("--envmaps-test", wanted.envmaps_test, output, seed, drawn)
        if shared := sorted(
            {os.path.realpath(name) for name in maps} & set(map(os.path.realpath, test_maps))
        ):
            raise UsageError(
                f"--envmaps-test {wanted.envmaps_test}: has {len(shared)} maps of --envmaps, such as "
                f"{Path(shared[0]).name}; give the test maps of its own"
            )
        return maps, test_maps
    if not dataset.splits["test"] or not (dataset.splits["train"] or dataset.splits["validation"]):
        return maps, maps
    if len(maps) < 2:
        raise UsageError(
            f"--envmaps {wanted.envmaps}: is one map, and the split test needs others; give it some by "
            "--envmaps-test"
        )
    test_maps = maps[::_TEST_MAPS_OF]
    return [name for index, name in enumerate(maps) if index % _TEST_MAPS_OF], test_maps


def _envmap_names(option: str, envmaps: str, output: Path, seed: int, first: int = 0) -> list[str]:
    """Names of the maps of an option; drawn ones begin at number `first` of their sequence."""
    if envmaps.startswith(_DRAWN):
        maps = parse_envmaps(envmaps, seed)
        return envmap_names(replace(maps, maps=first + len(maps)))[first:]
    if not Path(envmaps).exists():
        raise UsageError(f"{option} {envmaps}: no such folder; give one of lat-long maps, or procedural:N")
    return envmap_names([item.input_path for item in collect_items([envmaps], output, MAP_SUFFIXES)])


@dataclass(frozen=True)
class _Relight:
    """Relights one subject."""

    dataset: Dataset
    per_subject: int
    overwrite: bool

    def outputs_of(self, item: Item) -> list[Path]:
        """Paths of the sources of the subject's pairs."""
        return [image_path(self.dataset, item.name, index) for index in range(self.per_subject)]

    def __call__(self, item: Item) -> Outcome:
        """Write the sources that are missing."""
        pairs, weights = load_pairs(self.dataset)[item.name]
        made = relight_subject(self.dataset, pairs, weights, memory.limit_bytes(), self.overwrite)
        return Outcome(self.outputs_of(item), {"pictures": len(pairs), "made": made})


def _spread_maps(
    batch: BatchOptions, settings: Settings, work: Callable[[T], R], maps: Sequence[T]
) -> Iterator[R]:
    if batch.shard.of > 1:  # shards would write the same pairs at the same time
        raise UsageError(
            "--shard: the pairs are not drawn yet; run once with --lazy and without --shard first"
        )
    return with_bar(work, maps, "maps", batch, settings, _map_died)


def _map_died(task: Any, error: Exception) -> Any:
    return f"{task.name}: {process_died(error)}"
