"""The report of a run over a folder: report.jsonl, a row for each item."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from facerf_cli.batch.inputs import Item
from facerf_cli.batch.made_from import Made
from facerf_cli.batch.settings import Shard
from facerf_cli.errors import FacerfError, UsageError
from facerf_cli.files.atomic import atomic_path
from facerf_cli.files.json_reader import parse_json
from facerf_cli.files.regular import is_regular
from facerf_cli.run.logs import json_line, shown

REPORT_NAME, _SHARD_REPORTS = "report.jsonl", "report-*-of-*.jsonl"


@dataclass(frozen=True)
class Outcome:
    """The result of `process`: the files it wrote, and facts for the report's row."""

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


def report_name(shard: Shard) -> str:
    """The report's name; each shard has its own, since shards run at the same time."""
    return REPORT_NAME if shard.of == 1 else f"report-{shard.number}-of-{shard.of}.jsonl"


def open_report(
    path: Path,
    verb: str,
    todo: list[Item],
    finished: list[Item],
    outputs_of: Callable[[Item], Sequence[Path]],
) -> Path:
    """Start the report: older rows stay, except those of items that are about to be made again.

    A run without `--shard` takes over the rows of earlier shards.
    """
    rows = {(row.get("verb"), row.get("item")): row for row in rows_of(path)}
    for shard in sorted(path.parent.glob(_SHARD_REPORTS)) if path.name == REPORT_NAME else ():
        for row in rows_of(shard):
            key = row.get("verb"), row.get("item")
            if key not in rows or rows[key].get("status") == "failed":
                rows[key] = row
    for item in todo:
        rows.pop((verb, item.name), None)
    for item in finished:
        if (verb, item.name) not in rows:
            skipped = ItemResult(item, 0.0, Outcome(outputs_of(item)))
            rows[verb, item.name] = _row(verb, skipped, path.parent) | {"status": "skipped"}
    try:
        with atomic_path(path) as temporary:
            temporary.write_text("".join(json_line(row) + "\n" for row in rows.values()), encoding="utf-8")
    except FacerfError as error:
        raise unusable(path.parent, error.__cause__ or error) from error
    return path


def add_row(report: Path, verb: str, result: ItemResult) -> None:
    """Write the row of an item that was processed."""
    with report.open("a", encoding="utf-8") as stream:
        stream.write(json_line(_row(verb, result, report.parent)) + "\n")


def unusable(folder: Path, error: BaseException) -> UsageError:
    """The error of an output folder that cannot be written to."""
    reason = error.strerror if isinstance(error, OSError) else error
    return UsageError(f"-o {folder}: cannot be written to ({reason}); give another folder")


def rows_of(path: Path) -> Iterator[dict[str, Any]]:
    """The rows of a report; what is no row is passed over, a missing file holds none."""
    if not is_regular(path):
        return
    for line in path.read_text(encoding="utf-8", errors="replace").split("\n"):
        try:
            row = parse_json(line)
        except ValueError:  # a run that was killed may leave half a line
            continue
        if isinstance(row, dict) and isinstance(row.get("verb"), str) and isinstance(row.get("item"), str):
            yield row


def _row(verb: str, result: ItemResult, output_folder: Path) -> dict[str, Any]:
    outcome = result.outcome or Outcome([])
    row = {
        "verb": verb,
        "item": result.item.name,
        "input": result.item.input_path,
        "status": "failed" if result.error else "done",
        "seconds": result.seconds,
        "error": shown(result.error) or None,
        "outputs": [
            path.relative_to(output_folder) if path.is_relative_to(output_folder) else path
            for path in outcome.outputs
        ],
    }
    return row | {name: value for name, value in outcome.facts.items() if name not in row}
