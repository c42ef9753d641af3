"""The contract of every verb that walks folders: what is read, skipped, written and reported.

A verb passes a `Job` to `run_items`. It raises `InputError` for a faulty item (the run continues); any
other `FacerfError` concerns the whole run and ends it.
"""

import logging
import os
import re
import sys
import time
import traceback
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, suppress
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any, ClassVar, NamedTuple, Self, TypeVar

from facerf_cli.batch.inputs import Item, NamePattern, check_case, file_pattern, files_read, refuse_read
from facerf_cli.batch.journal import Journal, Made, Row, Writes, file_row, json_rows, lines_of
from facerf_cli.batch.recipe import DigestOf, Recipe, key_of
from facerf_cli.batch.settings import NOT_IN_RECIPE, Overwrite, Settings, Shard, torch_device
from facerf_cli.errors import FacerfError, InputError, UsageError
from facerf_cli.files.atomic import all_or_none, alone_in, asking, atomic_path, sweep_leftovers
from facerf_cli.files.texts import regular_size, require_regular
from facerf_cli.option import BATCH, option
from facerf_cli.run import memory
from facerf_cli.run.logs import (
    LOGGER_NAME,
    STDERR,
    counted,
    escaped,
    named,
    printable_line,
    unexpected,
)
from facerf_cli.run.machine import processors
from facerf_cli.run.stopping import end_again
from facerf_cli.run.workers import Workers, ending, process_died, spread

REPORT_NAME = "report.jsonl"
T = TypeVar("T")
R = TypeVar("R")
log = logging.getLogger(LOGGER_NAME)


class Job:
    """The work of a verb on each of its items; a frozen dataclass, which workers get in other processes."""

    items_a_process: ClassVar[int] = 0  # for which it pays to start one that nobody asked for; 0: never

    @property
    def verb(self) -> str:
        """Its name, for the report and the index."""
        raise NotImplementedError

    def outputs_of(self, item: Item) -> Sequence[Path]:
        """The files of a finished item."""
        raise NotImplementedError

    def recipes_of(self, digest_of: DigestOf) -> Sequence[Recipe]:
        """List what shapes each output besides its input, or all; without recipes what exists is finished."""
        return ()

    def ready(self, dry_run: bool) -> Self:
        """Load what all items need; not called where all is finished.

        Returns the job, or one that lacks the outputs that cannot be made, which are then a failure.
        """
        return self

    def __call__(self, item: Item) -> "Outcome":
        """Make the outputs of an item, or those that are stale."""
        raise NotImplementedError

    @property
    def process(self) -> Callable[[Item], "Outcome"]:
        """A function that does that; picklable. Not asked for where all is finished."""
        return self


@dataclass(frozen=True)
class Outcome:
    """The result of a `Job`: the files it wrote, and facts for the report's row."""

    outputs: Sequence[Path]
    facts: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class ItemResult:
    """The end of one item, in a form that can be sent between processes."""

    item: Item
    seconds: float
    outcome: Outcome | None = None
    made: Made | None = None
    error: str = ""
    trace: str = ""
    stops_the_run: FacerfError | None = None


def write_report(folder: Path, rows: Iterable[Row]) -> None:
    """Write the rows of items to report.jsonl, after those of other items that it has."""
    path = folder / REPORT_NAME
    table = {(row.get("verb"), row.get("item")): row for row in _earlier_rows(path)}
    for row in rows:
        table.pop((row["verb"], row["item"]), None)
        table[row["verb"], row["item"]] = row
    with atomic_path(path) as temporary:
        temporary.write_text(lines_of(table.values()), encoding="utf-8")


def _earlier_rows(path: Path) -> list[Row]:
    """The rows of a report; raises UsageError for a file of this name that is none."""
    rows = [
        row
        for row in json_rows(path)
        if isinstance(row.get("verb"), str) and isinstance(row.get("item"), str)
    ]
    if not rows and regular_size(path):
        raise UsageError(f"{path}: was not written by facerf; move it, or choose another -o")
    return rows


def unusable(folder: Path, error: BaseException) -> UsageError:
    """The error of an output folder that cannot be written to."""
    reason = error.strerror if isinstance(error, OSError) else error
    if folder.is_symlink() and not folder.exists():
        reason = "a link that leads nowhere"
    return UsageError(f"-o {folder}: cannot be written to ({reason}); give another folder")


def _row(verb: str, result: ItemResult, output_folder: Path) -> Row:
    outcome = result.outcome or Outcome([])
    row = {
        "verb": verb,
        "item": result.item.name,
        "input": named(result.item.input_path.as_posix()),
        "status": "failed" if result.error else "done",
        "seconds": result.seconds,
        "error": printable_line(result.error) or None,
        "outputs": [
            path.relative_to(output_folder) if path.is_relative_to(output_folder) else path
            for path in outcome.outputs
        ],
    }
    return row | {name: value for name, value in outcome.facts.items() if name not in row}


_JOB_BYTES = 2 << 30  # that a process which is not asked for may have
_FILE_SUFFIX = re.compile(
    r"\.(exr|hdr|png|jpe?g|tiff?|webp|gif|bmp|heic|avif|jsonl?|txt|csv|html|pdf|zip|npz|safetensors|glb|obj"
    r"|mp4|mov|m4v|webm|avi|mkv)",
    re.IGNORECASE,
)


def folder_not_file(output: Path, other: str = "") -> Path:
    """The folder that `-o` names; raises UsageError for a file's name, unless such a folder is there.

    `other` names the suffixes of files that may be given.
    """
    if _FILE_SUFFIX.fullmatch(output.suffix) and not output.is_dir():
        kinds = f", or a file as {other}" if other else ""
        folder = f"give a folder, such as -o {output.with_suffix('')}"
        raise UsageError(f"-o {output}: is a file's name; {folder}{kinds}")
    return output


@dataclass(frozen=True)
class BatchOptions:
    """The options of the contract.

    Attributes:
        output: Write the results to this folder.
        overwrite: Make again results that exist: never; those that were made from other inputs, options or
            networks (changed); or always.
        dry_run: List what would be read and written; write nothing.
        jobs: Process so many items at a time.
        shard: Process every Nth item only, from the Kth on; other machines take the rest.
        ray: Run as tasks of Ray on a cluster (HOST:PORT of its head, or auto) or on this machine (local).
        name: Name the outputs by a pattern of {dir}, {parent}, {stem}, {ext} and {frame:04}; what each is
            follows it.
        report: Write report.jsonl, too: a row for each item with its outputs, and facts or an error.
    """

    output: Path = option(
        Path(),
        metavar="DIR",
        in_recipe=False,
        flags=("--output", "-o"),
        shown_default=False,
        required=True,
        typed=Path,
        parse=folder_not_file,
    )
    overwrite: Overwrite = option("changed", in_recipe=False, panel=BATCH, everyday=True)
    dry_run: bool = option(False, in_recipe=False, panel=BATCH)
    jobs: int | None = option(
        None,
        in_recipe=False,
        flags=("--jobs", "-j"),
        shown_default="auto",
        least=1,
        panel=BATCH,
        everyday=True,
    )
    shard: Shard = option(
        Shard(), metavar="K/N", in_recipe=False, shown_default="all items", parse=Shard.parse, panel=BATCH
    )
    ray: str | None = option(None, metavar="ADDRESS", in_recipe=False, shown_default=False, panel=BATCH)
    name: NamePattern | None = option(
        None,
        metavar="PATTERN",
        in_recipe=False,
        shown_default="{dir}/{stem}.{frame}",
        parse=file_pattern,
        panel=BATCH,
    )
    report: bool = option(False, in_recipe=False, panel=BATCH)
    file: Path | None = field(default=None, metadata=NOT_IN_RECIPE)  # the one that -o names
    in_a_row: int = field(default=1, metadata=NOT_IN_RECIPE)  # neighbouring items that a process takes
    print_outputs: bool = field(default=True, metadata=NOT_IN_RECIPE)  # on stdout

    def workers(self, settings: Settings, unasked: int = 1) -> Workers:
        """The workers that `--jobs`, `--ray` and `--device` ask for; so many jobs where none is named."""
        jobs = self.jobs or (unasked if self.ray is None else 0)
        gpus = None if settings.device == "auto" else int(settings.device.startswith("cuda"))
        return Workers(jobs, self.ray, gpus, self.in_a_row)


def jobs_that_pay(items: int, items_a_process: int, settings: Settings) -> int:
    """Processes for so many items where `--jobs` is not given: a photo keeps two processors half busy.

    One for a GPU, and with `--memory`, which is a ceiling for each.
    """
    if items_a_process == 0 or settings.memory_bytes is not None:
        return 1
    memory_for = memory.default_limit() // _JOB_BYTES
    jobs = min(items // items_a_process, processors(), memory_for)
    return jobs if jobs > 1 and torch_device(settings).type == "cpu" else 1


def run_items(job: Job, items: Sequence[Item], options: BatchOptions, settings: Settings) -> int:
    """Process this process's share of the items; return the exit code: 0 all done, 1 some failed.

    Raises UsageError where the output folder cannot be used, or an output is a file to be read.
    """
    outputs = [path for item in items for path in job.outputs_of(item)]
    refuse_read(outputs, files_read((items, job), items))
    items = options.shard.share(items)
    with ExitStack() as stack:
        if not options.dry_run:
            try:
                stack.enter_context(alone_in(options.output, f".facerf-lock{options.shard.suffix}"))
            except OSError as error:
                raise unusable(options.output, error) from error
        check_case(outputs, options.output)
        if options.report:
            _earlier_rows(options.output / REPORT_NAME)
        journal = Journal(options.output, job.verb, options.shard, options.file)
        plan = _plan(job, items, options, journal)
        lacks = False
        if any(plan.stale.values()):
            usable = job.ready(options.dry_run)
            lacks = usable is not job
            if lacks:
                job, plan = usable, _plan(usable, items, options, journal)
        _log_plan(plan)
        if options.dry_run:
            for result in plan.refused:
                _print_result(result, options)
            failures = int(bool(plan.refused)) + _list_what_would_be_done(plan.stale)
        else:
            failures = _make(job, plan, journal, options, settings)
            if options.report:
                write_report(options.output, _rows_of(job, items, journal))
    return int(lacks or failures > 0)


class Plan(NamedTuple):
    """What a run makes.

    Attributes:
        keys: Digests of the recipes of an item's outputs.
        outputs: Of each item.
        stale: The outputs of each item that must be made, and why: '' where they never were.
        refused: The items that may not replace a file.
    """

    keys: Sequence[str]
    outputs: Mapping[Item, Sequence[Path]]
    stale: Mapping[Item, Mapping[Path, str]]
    refused: Sequence[ItemResult]


def _plan(job: Job, items: Sequence[Item], options: BatchOptions, journal: Journal) -> Plan:
    keys = [key_of(recipe) for recipe in job.recipes_of(journal.digest_of)]
    each = {item: job.outputs_of(item) for item in items}
    stale: dict[Item, dict[Path, str]] = {}
    refused: list[ItemResult] = []
    for item, outputs in each.items():
        if not keys:
            done = options.overwrite != "always" and _exist(outputs)
            stale[item] = {} if done else dict.fromkeys(outputs, "")
            continue
        try:
            stale[item] = journal.to_make(item, outputs, keys, options.overwrite)
        except InputError as error:
            refused.append(ItemResult(item, 0.0, error=str(error)))
    return Plan(keys, each, stale, refused)


def _make(job: Job, plan: Plan, journal: Journal, options: BatchOptions, settings: Settings) -> int:
    """Make what is stale, note and print the end of each item; return how many failed."""
    todo = [_to_make(item, plan, journal, options) for item, paths in plan.stale.items() if paths]
    try:
        journal.open([*todo, *(result.item for result in plan.refused)])
    except FacerfError as error:
        raise unusable(options.output, error.__cause__ or error) from error
    if plan.keys and options.overwrite == "changed":
        for item, stale in plan.stale.items():
            kept = [path for path in plan.outputs[item] if path not in stale]
            keep_newer(kept, files_read((item, job), [item]))

    def done(result: ItemResult) -> int:
        """Note and print the result of an item; return 1 for a failure."""
        row = _row(job.verb, result, options.output)
        outputs = job.outputs_of(result.item) if result.made else ()  # may depend on what was made
        journal.add(result.item, row, result.made, outputs, plan.keys)
        return _print_result(result, options)

    failures = sum(map(done, plan.refused))
    if todo:
        owner = (options.output, job.verb, journal.path, options.overwrite) if plan.keys else None
        with ending(_results(job, todo, owner, options, settings)) as results:
            failures += sum(map(done, results))
    if failures and len(plan.outputs) > 1:
        log.error("%d of %d failed; %s has a row for each", failures, len(plan.outputs), journal.path)
    return failures


def _rows_of(job: Job, items: Sequence[Item], journal: Journal) -> Iterator[Row]:
    """The journal's rows of items; that of one without a row says that it was skipped."""
    for item in items:
        skipped = _row(job.verb, ItemResult(item, 0.0, Outcome(job.outputs_of(item))), Path())
        yield journal.items.get((job.verb, item.name)) or skipped | {"status": "skipped"}


Owner = tuple[Path, str, Path, Overwrite]  # output folder, command, its journal, --overwrite


def _results(
    job: Job, todo: Sequence[Item], owner: Owner | None, options: BatchOptions, settings: Settings
) -> Iterator[ItemResult]:
    """Process items by workers, with a progress bar; yield their results."""
    workers = options.workers(
        settings, jobs_that_pay(len(todo), job.items_a_process * options.in_a_row, settings)
    )
    at_once = min(workers.jobs or processors(), len(todo))
    work = partial(_run_one, job.process, owner, settings.job_bytes(at_once))
    memory.collect_as_usual()
    try:
        with ending(spread_with_bar(work, todo, job.verb, workers, settings, _broken)) as results:
            for result in results:
                if result.stops_the_run is not None:
                    raise result.stops_the_run
                yield result
    finally:
        if workers.jobs > 1:  # a worker that was killed could not remove what it was writing
            for folder in {path.parent for item in todo for path in job.outputs_of(item)}:
                sweep_leftovers(folder)


def _to_make(item: Item, plan: Plan, journal: Journal, options: BatchOptions) -> Item:
    """Return an item with the outputs that its work may replace and keeps, and the key of its one file."""
    outputs, stale = plan.outputs[item], plan.stale[item]
    others = journal.replaceable(item).difference(outputs) if plan.keys else set()
    key = journal.key_of(item, plan.keys[0]) if plan.keys and options.file else ""
    return replace(item, stale=frozenset({*stale, *others}), kept=frozenset(outputs) - set(stale), key=key)


def keep_newer(outputs: Sequence[Path], read: Iterable[Path]) -> None:
    """Set the time of finished outputs that are older than a file they were made from, as Make expects."""
    with suppress(OSError):
        newest_ns = max((path.stat().st_mtime_ns for path in read), default=0) if outputs else 0
        for path in outputs:
            if path.stat().st_mtime_ns < newest_ns:
                os.utime(path)


def sums_up(
    items: Sequence[Item], outputs_of: Callable[[Item], Sequence[Path]], options: BatchOptions
) -> bool:
    """True if a verb may now write what depends on all items.

    Without `--shard` always. A shard may when the items of all shards are finished, so the last one does; not
    with `--overwrite always`, since an earlier run's outputs look the same.
    """
    if options.shard.of == 1:
        return True
    always = options.overwrite == "always"
    left = len(items) if always else sum(not _exist(outputs_of(item)) for item in items)
    if left:
        state = "may be unfinished" if always else f"({left}) are unfinished"
        log.info(
            "items %s, so there is no summary; a run without --shard and --overwrite always writes it", state
        )
    return not left


def _run_one(
    process: Callable[[Item], Outcome],
    owner: Owner | None,
    memory_bytes: int,
    item: Item,
) -> ItemResult:
    """Run `process` on an item and return an `ItemResult`, whatever happens.

    A job without recipes has no `owner`: it replaces its outputs.
    """
    start_s = time.perf_counter()
    memory.set_limit(memory_bytes)

    def result(**ends: Any) -> ItemResult:
        return ItemResult(item, round(time.perf_counter() - start_s, 3), **ends)

    try:
        if item.is_file:
            require_regular(item.input_path)
        if owner is None:
            return result(outcome=process(item))
        read = {} if item.is_drawn else file_row(item.input_path)
        writes = Writes(item, *owner)
        with ExitStack() as stack:
            stack.enter_context(asking(writes))
            if item.is_file:
                stack.enter_context(all_or_none())
            outcome = process(item)
        outcome = replace(outcome, outputs=[path for path in outcome.outputs if path not in writes.left])
        return result(outcome=outcome, made=Made(read, writes.rows(outcome.outputs)))
    except InputError as error:
        return result(error=str(error), trace=traceback.format_exc())
    except FacerfError as error:
        return result(stops_the_run=error)
    except Exception as error:  # a bug must not cost the other items
        return result(error=f"{item.input_path}: {unexpected(error)}", trace=traceback.format_exc())
    finally:
        memory.give_back()
        end_again()


def _broken(item: Item, error: Exception) -> ItemResult:
    """The result of an item whose process died."""
    return ItemResult(item, 0.0, error=f"{item.input_path}: {process_died(error)}")


def _exist(outputs: Sequence[Path]) -> bool:
    return bool(outputs) and all(path.is_dir() or regular_size(path) for path in outputs)


def _log_plan(plan: Plan) -> None:
    """Log how many results are finished, and why others are made again."""
    stale = sum(map(len, plan.stale.values()))
    if kept := sum(len(plan.outputs[item]) for item in plan.stale) - stale:
        log.info("%d of %d results are finished and kept", kept, kept + stale)
    reasons = Counter(next(filter(None, paths.values()), "") for paths in plan.stale.values())
    for reason, count in sorted(reasons.items()):
        if reason:
            log.info("%d to make again: %s", count, reason)


def _list_what_would_be_done(stale: Mapping[Item, Mapping[Path, str]]) -> int:
    for item, paths in stale.items():
        for path in paths:
            print_path(named(f"{item.input_path} -> {path}"))
    log.info("dry run: %s would be made", counted(sum(map(len, stale.values())), "result"))
    missing = [item for item in stale if item.is_file and not os.path.exists(item.input_path)]
    for item in missing:
        log.error("%s: no such file; check the path", item.input_path)
    return int(bool(missing))


def _print_result(result: ItemResult, options: BatchOptions) -> int:
    """Print outputs to stdout, an error to stderr; return 1 for a failure."""
    if result.error:
        log.error("%s", result.error)
        if result.trace:
            log.debug("%s", "\n" + result.trace)
        return 1
    if result.outcome and options.print_outputs:
        for path in result.outcome.outputs:
            print_path(path)
    return 0


def print_path(text: object) -> None:
    """Print a name to standard output, for people escaped, for programs as it is."""
    print(escaped(str(text)) if sys.stdout.isatty() else text, flush=True)


def spread_with_bar(
    work: Callable[[T], R],
    items: Sequence[T],
    title: str,
    workers: Workers,
    settings: Settings,
    died: Callable[[T, Exception], R],
) -> Iterator[R]:
    """Map items by workers, with a progress bar on stderr if that is a terminal."""
    from rich.progress import Progress  # --help does without it

    shown = STDERR.is_terminal and settings.verbosity >= 0 and not settings.log_json
    # rich would send what is printed to stdout to its console, stderr: right only if both are one terminal.
    bar = Progress(console=STDERR, disable=not shown, redirect_stdout=sys.stdout.isatty())
    with bar, ending(spread(work, items, workers, died)) as results:
        yield from bar.track(results, total=len(items), description=title)
