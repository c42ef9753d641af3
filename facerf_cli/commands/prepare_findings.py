"""What `prepare-dataset` does with the findings of a capture's checks: stop a subject, tell, write down.

A dataset's findings.jsonl has them all; findings/SUBJECT.jsonl each subject's, where it has any, written
before the subject is worked on.
"""

import logging
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from facerf_cli.commands.capture_checks import show_findings
from facerf_cli.commands.inputs import Item
from facerf_cli.commands.options import Settings
from facerf_cli.commands.workers import spread
from facerf_cli.errors import InputError, UsageError
from facerf_cli.records import LOGGER_NAME, STDERR, counted, json_line

if TYPE_CHECKING:
    from facerf_cli.stage.checks.findings import Finding
    from facerf_cli.stage.data.capture import Capture

FINDINGS_FILE, _FOLDER = "findings.jsonl", "findings"
_ROWS_LIMIT_BYTES = 256 << 20
log = logging.getLogger(LOGGER_NAME)


def check(capture: "Capture", subject: str) -> "list[Finding]":
    """Findings about a subject's frames, less those that the capture itself gives up.

    What the camera saw is looked at, before a colour chart's matrix hides which channel was clipped.
    """
    from facerf_cli.stage.checks.subject import check_subject

    marked = capture.marked.get(subject, frozenset())
    return [
        found
        for found in check_subject(replace(capture, charts=()), subject)
        if not (found.check == "missing" and found.light in marked)
    ]


def require_sound(subject: str, findings: "Iterable[Finding]", strict: bool) -> None:
    """An InputError where findings stop the subject."""
    from facerf_cli.stage.checks.findings import stopping

    if at_fault := stopping(findings, strict):
        first = at_fault[0]
        more = f" ({len(at_fault)} such findings, see {FINDINGS_FILE})" if len(at_fault) > 1 else ""
        advice = "" if first.severity == "error" else "; without --strict it would do"
        raise InputError(f"{first.place}: {first.check}: {first.words}{advice}{more}")


def write_findings(folder: Path, subject: str, findings: "Sequence[Finding]") -> None:
    """Keep a subject's findings in a dataset's folder; none where there are none."""
    path = folder / _FOLDER / f"{subject}.jsonl"
    if findings:
        _write_rows(path, (found.row() for found in findings))
    else:
        path.unlink(missing_ok=True)


def collect_findings(folder: Path, subjects: Iterable[str]) -> dict[str, list[dict[str, Any]]]:
    """Write `findings.jsonl` of all subjects' findings, and give its rows by subject."""
    rows = {subject: _read_rows(folder / _FOLDER / f"{subject}.jsonl") for subject in subjects}
    _write_rows(folder / FINDINGS_FILE, (row for of_subject in rows.values() for row in of_subject))
    return {subject: of_subject for subject, of_subject in rows.items() if of_subject}


def check_all(
    work: "CheckOnly", items: Sequence[Item], output: Path, jobs: int, strict: bool, settings: Settings
) -> int:
    """Check all subjects, print the table, write `findings.jsonl`; 1 where a subject would be stopped.

    A UsageError with `--shard`: the file is of all subjects, and no shard would know that it is the last.
    """
    if settings.shard.of > 1:
        raise UsageError("--checks only looks at all subjects; leave --shard out, and give --jobs or --ray")
    from rich.progress import track

    from facerf_cli.stage.checks.findings import stopping

    shown = STDERR.is_terminal and settings.verbosity >= 0 and not settings.log_json
    results = spread(work, items, jobs, settings, _died)
    bar = track(results, "checks", len(items), console=STDERR, transient=True, disable=not shown)
    findings = [found for of_subject in bar for found in of_subject]
    rows = [found.row() for found in findings]
    _write_rows(output / FINDINGS_FILE, rows)
    show_findings(rows, strict)
    if not rows:
        log.info("checked: %s, nothing found", counted(len(items), "subject"))
    print(output / FINDINGS_FILE)
    return 1 if stopping(findings, strict) else 0


@dataclass(frozen=True)
class CheckOnly:
    """Checks one subject of a capture that `opened` reads."""

    opened: Any  # () -> Capture; can be sent to other processes

    def __call__(self, item: Item) -> "list[Finding]":
        """The subject's findings."""
        from facerf_cli.stage.threads import one_thread

        with one_thread():
            return check(self.opened(), item.name)


def _died(item: Item, error: Exception) -> "list[Finding]":
    from facerf_cli.stage.checks.findings import Finding

    words = f"its process died, perhaps for want of memory; try fewer --jobs ({error})"
    return [Finding("error", "unchecked", item.name, words)]


def _write_rows(path: Path, rows: "Iterable[Mapping[str, Any]]") -> None:
    from facerf_cli.files.atomic import atomic_path

    with atomic_path(path) as temporary:
        temporary.write_text("".join(json_line(row) + "\n" for row in rows), encoding="utf-8")


def _read_rows(path: Path) -> list[dict[str, Any]]:
    import json

    if not path.is_file() or path.stat().st_size > _ROWS_LIMIT_BYTES:
        return []
    lines = path.read_text(encoding="utf-8", errors="replace").splitlines()
    try:
        rows = [json.loads(line) for line in lines]
    except ValueError:
        raise InputError(f"{path}: damaged; remove it, and give --overwrite to check again") from None
    return [row for row in rows if isinstance(row, dict)]
