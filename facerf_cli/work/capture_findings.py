"""Findings of a capture's checks: run the checks, keep the findings in files, show them as a table.

A dataset's findings.jsonl has a row for every finding; findings/SUBJECT.jsonl has those of a subject, written
before the subject is prepared.
"""

import logging
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.progress import track
from rich.table import Table
from rich.text import Text

from facerf_cli.batch.inputs import Item
from facerf_cli.batch.run import BatchOptions
from facerf_cli.batch.settings import Settings
from facerf_cli.capture.capture import Capture
from facerf_cli.capture.checks.subject import check_subject
from facerf_cli.capture.findings import Finding, stopping
from facerf_cli.errors import InputError, UsageError
from facerf_cli.files.atomic import atomic_path
from facerf_cli.files.texts import parse_json
from facerf_cli.run.logs import LOGGER_NAME, STDERR, counted, json_line, one_line
from facerf_cli.run.workers import one_thread, process_died, spread

FINDINGS_FILE, _FOLDER = "findings.jsonl", "findings"
_ROWS_LIMIT_BYTES = 256 << 20
_SHOWN_ALIKE = 3  # findings of one check in a camera; the table counts the rest
_STYLES = {"error": "red", "warning": "yellow"}
_PLAIN_WIDTH = 160  # of a log file, which has no width
log = logging.getLogger(LOGGER_NAME)

Row = Mapping[str, Any]  # of `Finding.row`


def check_all(
    work: "CheckOnly", items: Sequence[Item], batch: BatchOptions, strict: bool, settings: Settings
) -> int:
    """Check all subjects, print the table and write findings.jsonl; return 1 if a subject would be stopped.

    UsageError with `--shard`, because the file covers all subjects.
    """
    if batch.shard.of > 1:
        raise UsageError("--shard: --checks only checks all subjects; omit it, and give --jobs or --ray")
    shown = STDERR.is_terminal and settings.verbosity >= 0 and not settings.log_json
    results = spread(work, items, batch.workers(settings), _died)
    bar = track(results, "checks", len(items), console=STDERR, transient=True, disable=not shown)
    findings = [found for of_subject in bar for found in of_subject]
    rows = [found.row() for found in findings]
    _write_rows(batch.output / FINDINGS_FILE, rows)
    show_findings(rows, strict)
    if not rows:
        log.info("checked: %s, nothing found", counted(len(items), "subject"))
    print(batch.output / FINDINGS_FILE)
    return 1 if stopping(findings, strict) else 0


@dataclass(frozen=True)
class CheckOnly:
    """Checks one subject of a capture; `opened` reads the capture in other processes, too."""

    opened: Callable[[], Capture]

    def __call__(self, item: Item) -> list[Finding]:
        """Check a subject on one thread."""
        with one_thread():
            return check_subject(self.opened(), item.name)


def _died(item: Item, error: Exception) -> list[Finding]:
    return [Finding("error", "unchecked", item.name, process_died(error))]


def require_sound(subject: str, findings: Iterable[Finding], strict: bool) -> None:
    """Raise InputError where findings stop the subject."""
    if at_fault := stopping(findings, strict):
        first = at_fault[0]
        more = f" ({len(at_fault)} such findings, see {FINDINGS_FILE})" if len(at_fault) > 1 else ""
        advice = "" if first.severity == "error" else "; without --strict it is a warning"
        raise InputError(f"{first.place}: {first.check}: {first.words}{advice}{more}")


def write_findings(folder: Path, subject: str, findings: Sequence[Finding]) -> None:
    """Write a subject's findings into a dataset's folder, or remove the file where there are none."""
    path = folder / _FOLDER / f"{subject}.jsonl"
    if findings:
        _write_rows(path, (found.row() for found in findings))
    else:
        path.unlink(missing_ok=True)


def collect_findings(folder: Path, subjects: Iterable[str]) -> dict[str, list[dict[str, Any]]]:
    """Write findings.jsonl from all subjects' files, and return its rows by subject."""
    rows = {subject: _read_rows(folder / _FOLDER / f"{subject}.jsonl") for subject in subjects}
    _write_rows(folder / FINDINGS_FILE, (row for of_subject in rows.values() for row in of_subject))
    return {subject: of_subject for subject, of_subject in rows.items() if of_subject}


def _write_rows(path: Path, rows: Iterable[Row]) -> None:
    with atomic_path(path) as temporary:
        temporary.write_text("".join(json_line(row) + "\n" for row in rows), encoding="utf-8")


def _read_rows(path: Path) -> list[dict[str, Any]]:
    if not path.is_file() or path.stat().st_size > _ROWS_LIMIT_BYTES:
        return []
    lines = path.read_text(encoding="utf-8", errors="replace").splitlines()
    try:
        rows = [parse_json(line) for line in lines]
    except ValueError:
        raise InputError(f"{path}: damaged; remove it, and give --overwrite always to check again") from None
    return [row for row in rows if isinstance(row, dict)]


def show_findings(rows: Sequence[Row], strict: bool = False, console: Console = STDERR) -> None:
    """Print rows as a table, if there are any; with `strict`, each of them stops its subject."""
    if strict:
        rows = [{**row, "severity": "error", "leaves_out": False} for row in rows]
    if rows:
        wide = console if console.is_terminal else Console(file=console.file, width=_PLAIN_WIDTH)
        wide.print(findings_table(rows))


def findings_table(rows: Sequence[Row]) -> Table:
    """Table of findings, errors first, then by subject; similar ones beyond the first few are counted."""
    table = Table(title=summary(rows), title_justify="left", title_style="bold", expand=False)
    for name in ("where", "check", "what follows"):
        table.add_column(name, no_wrap=name != "what follows", overflow="fold")
    table.add_column("finding", overflow="fold")
    for row, more in _shortened(rows):
        words = one_line(str(row["words"])) + (f" (and {more} more like it)" if more else "")
        where = "/".join(str(row[key]) for key in ("subject", "camera", "light") if row.get(key))
        style = _STYLES.get(str(row["severity"]), "")
        table.add_row(Text(where), Text(str(row["check"])), Text(consequence(row), style), Text(words))
    return table


def summary(rows: Sequence[Row]) -> str:
    """Title of the table: counts by consequence."""
    subjects = len({row["subject"] for row in rows})
    kinds = [consequence(row) for row in rows]
    counts = ((kinds.count(kind), kind) for kind in ("subject stopped", "frame left out", "warning"))
    words = ", ".join(f"{count} x {kind}" for count, kind in counts if count)
    return f"Findings about {counted(subjects, 'subject')}: {words}"


def consequence(row: Row) -> str:
    """Consequence of a finding for its subject."""
    if row["leaves_out"]:
        return "frame left out"
    return "subject stopped" if row["severity"] == "error" else "warning"


def _shortened(rows: Sequence[Row]) -> Iterator[tuple[Row, int]]:
    """The first rows of each check in a camera; the last of them with the number of omitted ones."""
    groups: dict[tuple[Any, ...], list[Row]] = {}
    for row in rows:
        is_warning = consequence(row) == "warning"
        key = (is_warning, row["leaves_out"], row["subject"], row.get("camera") or "", row["check"])
        groups.setdefault(key, []).append(row)
    for key in sorted(groups):
        group = groups[key]
        for place, row in enumerate(group[:_SHOWN_ALIKE], start=1):
            yield row, len(group) - _SHOWN_ALIKE if place == _SHOWN_ALIKE else 0
