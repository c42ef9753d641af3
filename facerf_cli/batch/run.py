"""The contract of every command that processes folders: what is read, skipped, written and reported.

A command passes a `Job` to `run_items`. It raises `InputError` for a faulty item, and the run continues; any
other `FacerfError` ends the run.
"""

import logging
import os
import sys
import time
import traceback
from collections import Counter
from collections.abc import Callable, Generator, Mapping, Sequence
from contextlib import ExitStack, closing
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any, ClassVar, NamedTuple, Self

from facerf_cli.batch.inputs import Item, check_case, files_read, refuse_read
from facerf_cli.batch.journal import Journal, Made, Row, Writes, file_row, item_of, json_rows, lines_of
from facerf_cli.batch.recipe import DigestOf, Recipe, key_of
from facerf_cli.batch.settings import BatchOptions, Settings, default_job_count
from facerf_cli.errors import FacerfError, InputError, UsageError
from facerf_cli.files.atomic import all_or_none, alone_in, asking, atomic_path, sweep_leftovers
from facerf_cli.files.texts import regular_size, require_regular
from facerf_cli.run import memory
from facerf_cli.run.logs import LOGGER_NAME, counted, escaped, named, printable_line, unexpected
from facerf_cli.run.machine import processors
from facerf_cli.run.stopping import end_again
from facerf_cli.run.workers import process_died, spread

REPORT_NAME = "report.jsonl"
Outputs = Mapping[Item, Sequence[Path]]
WritesOf = Callable[[Item], Writes]
log = logging.getLogger(LOGGER_NAME)


class Job:
    """The work of a command on each of its items; a frozen dataclass that is sent to other processes."""

    items_a_process: ClassVar[int] = 0  # at least, for a process that facerf starts unasked; 0: never

    @property
    def verb(self) -> str:
        """Name of the command, for the report and the journal."""
        raise NotImplementedError

    def outputs_of(self, item: Item) -> Sequence[Path]:
        """Return the files of a finished item."""
        raise NotImplementedError

    def recipes_of(self, digest_of: DigestOf) -> Sequence[Recipe]:
        """Return what shapes each output besides its input; without recipes, existing outputs are finished.

        One recipe may serve all outputs.
        """
        return ()

    def ready(self, dry_run: bool) -> Self:
        """Load what all items need; not called if all items are finished.

        Returns the job, or a job without the outputs that cannot be made, which then count as failures.
        """
        return self

    def __call__(self, item: Item) -> "Outcome":
        """Make the outputs of an item, or its stale ones."""
        raise NotImplementedError

    @property
    def process(self) -> Callable[[Item], "Outcome"]:
        """A picklable function that does so; not asked for if all items are finished."""
        return self


@dataclass(frozen=True)
class Outcome:
    """The result of a `Job`: the files it wrote, and facts for the report's row."""

    outputs: Sequence[Path]
    facts: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class ItemResult:
    """How one item ended, in a form that can be sent between processes."""

    item: Item
    seconds: float
    outcome: Outcome | None = None
    made: Made | None = None
    error: str = ""
    trace: str = ""
    stops_the_run: FacerfError | None = None

    def row(self, verb: str, folder: Path) -> Row:
        """Return the row of the report; outputs are relative to the folder."""
        outcome = self.outcome or Outcome([])
        outputs = (
            path.relative_to(folder) if path.is_relative_to(folder) else path for path in outcome.outputs
        )
        row = {
            "verb": verb,
            "item": self.item.name,
            "input": named(self.item.input_path.as_posix()),
            "status": "failed" if self.error else "done",
            "seconds": self.seconds,
            "error": printable_line(self.error) or None,
            "outputs": list(outputs),
        }
        return {**row, **outcome.facts, **row}


def write_report(folder: Path, rows: Mapping[tuple[str, str], Row] | None = None) -> None:
    """Write rows of items, by command and item, and those of other items in report.jsonl to that file.

    Without rows only check that facerf wrote it: else raise UsageError.
    """
    path = folder / REPORT_NAME
    earlier = {names: row for row in json_rows(path) if (names := item_of(row))}
    if not earlier and regular_size(path):
        raise UsageError(f"{path}: was not written by facerf; move it, or choose another -o")
    if rows:
        with atomic_path(path) as temporary:
            temporary.write_text(lines_of((earlier | {**rows}).values()), encoding="utf-8")


def run_items(job: Job, items: Sequence[Item], options: BatchOptions, settings: Settings) -> int:
    """Process this process's share of the items; return the exit code: 0 all done, 1 some failed.

    Raises UsageError if the output folder cannot be used, or an output is a file to be read.
    """
    outputs = {item: job.outputs_of(item) for item in items}
    refuse_read((path for paths in outputs.values() for path in paths), files_read((items, job), items))
    items = options.shard.share(items)
    with ExitStack() as stack:
        if not options.dry_run:
            try:
                stack.enter_context(alone_in(options.output, f".facerf-lock{options.shard.suffix}"))
            except OSError as error:
                reason = f"cannot be written to ({error.strerror}); use another folder"
                raise UsageError(f"-o {options.output}: {reason}") from error
        if (options.output / f".FACERF-LOCK{options.shard.suffix}").exists():  # case is ignored there
            check_case(path for paths in outputs.values() for path in paths)
        if options.report:
            write_report(options.output)
        journal = Journal(options.output, job.verb, options.shard, options.file)
        plan = _plan(job, {item: outputs[item] for item in items}, options, journal)
        lacks = False
        if any(plan.stale.values()):
            usable = job.ready(options.dry_run)
            lacks = usable is not job
            if lacks:
                job = usable
                plan = _plan(job, {item: job.outputs_of(item) for item in items}, options, journal)
        _log_plan(plan)
        if options.dry_run:
            for result in plan.rejected:
                _print_result(result, options)
            failures = int(bool(plan.rejected)) + _list_planned(plan.stale)
        else:
            failures = _make(job, plan, journal, options, settings)
            if options.report:
                write_report(options.output, journal.items)
    return int(lacks or failures > 0)


class Plan(NamedTuple):
    """What a run makes.

    Attributes:
        keys: Digests of the recipes of an item's outputs.
        outputs: Outputs of each item.
        stale: Outputs of each item that must be made, and why: '' if they were never made.
        rejected: Items that may not replace a file.
    """

    keys: Sequence[str]
    outputs: Outputs
    stale: Mapping[Item, Mapping[Path, str]]
    rejected: Sequence[ItemResult]


def _plan(job: Job, outputs: Outputs, options: BatchOptions, journal: Journal) -> Plan:
    keys = [key_of(recipe) for recipe in job.recipes_of(journal.digest_of)]
    stale: dict[Item, dict[Path, str]] = {}
    rejected: list[ItemResult] = []
    for item, paths in outputs.items():
        if not keys:
            done = options.overwrite != "always" and _exist(paths)
            stale[item] = {} if done else dict.fromkeys(paths, "")
            continue
        try:
            stale[item] = journal.to_make(item, paths, keys, options.overwrite)
        except InputError as error:
            rejected.append(ItemResult(item, 0.0, error=str(error)))
    return Plan(keys, outputs, stale, rejected)


def _make(job: Job, plan: Plan, journal: Journal, options: BatchOptions, settings: Settings) -> int:
    """Make stale outputs, note and print how each item ended; return how many failed."""
    todo = [_to_make(item, plan, journal, options) for item, paths in plan.stale.items() if paths]
    journal.open([*todo, *(result.item for result in plan.rejected)])

    def done(result: ItemResult) -> int:
        row, outputs = result.row(job.verb, options.output), plan.outputs[result.item]
        journal.add(result.item, row, result.made, outputs, plan.keys)
        return _print_result(result, options)

    failures = sum(map(done, plan.rejected))
    if todo:
        writes_of = partial(Writes, options.output, job.verb, journal.path, options.overwrite)
        work = partial(_run_one, job.process, writes_of if plan.keys else None)
        with closing(_results(job, work, todo, plan.outputs, options, settings)) as results:
            failures += sum(map(done, results))
    if failures and len(plan.outputs) > 1:
        log.error("%d of %d failed; %s has a row for each", failures, len(plan.outputs), journal.path)
    return failures


def _to_make(item: Item, plan: Plan, journal: Journal, options: BatchOptions) -> Item:
    """Return an item with the outputs that its work may replace and keeps, and the key of its single file."""
    outputs, stale = plan.outputs[item], plan.stale[item]
    others = journal.replaceable(item).difference(outputs) if plan.keys else set()
    key = journal.key_of(item, plan.keys[0]) if plan.keys and options.file else ""
    return replace(item, stale=frozenset({*stale, *others}), kept=frozenset(outputs) - set(stale), key=key)


def _results(
    job: Job,
    work: Callable[[int, Item], ItemResult],
    todo: Sequence[Item],
    outputs: Outputs,
    options: BatchOptions,
    settings: Settings,
) -> Generator[ItemResult]:
    """Process items by workers, with a progress bar; yield their results."""
    items_per_process = job.items_a_process * options.in_a_row
    workers = options.workers(settings, default_job_count(len(todo), items_per_process, settings))
    at_once = min(workers.jobs or processors(), len(todo))
    work = partial(work, settings.job_bytes(at_once))
    memory.collect_as_usual()

    def died(item: Item, error: Exception) -> ItemResult:
        return ItemResult(item, 0.0, error=f"{item.input_path}: {process_died(error)}")

    try:
        with closing(spread(work, todo, workers, died, job.verb)) as results:
            for result in results:
                if result.stops_the_run is not None:
                    raise result.stops_the_run
                yield result
    finally:
        if workers.jobs > 1:  # a killed worker could not remove what it was writing
            for folder in {path.parent for item in todo for path in outputs[item]}:
                sweep_leftovers(folder)


def _run_one(
    process: Callable[[Item], Outcome], writes_of: WritesOf | None, memory_bytes: int, item: Item
) -> ItemResult:
    """Run `process` on an item and return an `ItemResult`, even if it fails.

    A job without recipes, which has no `writes_of`, replaces its outputs.
    """
    start_s = time.perf_counter()
    memory.set_limit(memory_bytes)

    def result(**ends: Any) -> ItemResult:
        return ItemResult(item, round(time.perf_counter() - start_s, 3), **ends)

    try:
        if item.is_file:
            require_regular(item.input_path)
        if writes_of is None:
            return result(outcome=process(item))
        read = {} if item.is_drawn else file_row(item.input_path)
        writes = writes_of(item)
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
    except Exception as error:  # a bug must not affect other items
        return result(error=f"{item.input_path}: {unexpected(error)}", trace=traceback.format_exc())
    finally:
        memory.give_back()
        end_again()


def sums_up(
    items: Sequence[Item], outputs_of: Callable[[Item], Sequence[Path]], options: BatchOptions
) -> bool:
    """Tell whether a command may now write what depends on all items.

    Without `--shard` it always may. With shards the last one may, when the items of all are finished; not
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


def _exist(outputs: Sequence[Path]) -> bool:
    return bool(outputs) and all(path.is_dir() or regular_size(path) for path in outputs)


def _log_plan(plan: Plan) -> None:
    stale = sum(map(len, plan.stale.values()))
    if kept := sum(len(plan.outputs[item]) for item in plan.stale) - stale:
        log.info("%d of %d results are finished and kept", kept, kept + stale)
    reasons = Counter(next(filter(None, paths.values()), "") for paths in plan.stale.values())
    for reason, count in sorted(reasons.items()):
        if reason:
            log.info("%s out of date: %s", counted(count, "item"), reason)


def _list_planned(stale: Mapping[Item, Mapping[Path, str]]) -> int:
    """Print what a run would make; return 1 if an input does not exist."""
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
    """Print a name to standard output; a terminal gets it escaped."""
    print(escaped(str(text)) if sys.stdout.isatty() else text, flush=True)
