"""Findings of a capture's checks: kept in files, and shown as a table.

A dataset's findings.jsonl has a row for every finding; findings/SUBJECT.jsonl has those of a subject, written
before the subject is prepared.
"""

from collections.abc import Iterable, Sequence
from itertools import groupby
from pathlib import Path

from rich.console import Console
from rich.table import Table
from rich.text import Text

from facerf_cli.capture.findings import CONSEQUENCES, Finding, stopping
from facerf_cli.errors import InputError
from facerf_cli.files.atomic import atomic_path
from facerf_cli.files.texts import parse_json, text_of
from facerf_cli.run.logs import STDERR, counted, json_line, one_line

FINDINGS_FILE, _FOLDER = "findings.jsonl", "findings"
_SHOWN_ALIKE = 3  # findings of one check in a camera; the table counts the rest
_STYLES = dict(zip(CONSEQUENCES, ("red", "red", "yellow"), strict=True))
_PLAIN_WIDTH = 160  # of a log file, which has no width


def require_sound(subject: str, findings: Iterable[Finding], strict: bool) -> None:
    """Raise InputError where findings stop the subject."""
    if at_fault := stopping(findings, strict):
        first = at_fault[0]
        more = f" ({len(at_fault)} such findings, see {FINDINGS_FILE})" if len(at_fault) > 1 else ""
        advice = "" if first.severity == "error" else "; without --strict it is a warning"
        raise InputError(f"{first.place}: {first.check}: {first.words}{advice}{more}")


def write_findings(path: Path, findings: Iterable[Finding]) -> None:
    """Write a row for each finding."""
    with atomic_path(path) as temporary:
        rows = (json_line(found.row()) + "\n" for found in findings)
        temporary.write_text("".join(rows), encoding="utf-8")


def keep_findings(folder: Path, subject: str, findings: Sequence[Finding]) -> None:
    """Write a subject's findings into a dataset's folder, or remove the file where there are none."""
    path = folder / _FOLDER / f"{subject}.jsonl"
    if findings:
        write_findings(path, findings)
    else:
        path.unlink(missing_ok=True)


def collect_findings(folder: Path, subjects: Iterable[str]) -> dict[str, list[Finding]]:
    """Write findings.jsonl from all subjects' files, and return the findings by subject."""
    found = {subject: _read_findings(folder / _FOLDER / f"{subject}.jsonl") for subject in subjects}
    write_findings(folder / FINDINGS_FILE, (one for of_subject in found.values() for one in of_subject))
    return {subject: of_subject for subject, of_subject in found.items() if of_subject}


def _read_findings(path: Path) -> list[Finding]:
    if not path.is_file():
        return []
    lines = text_of(path.read_bytes(), "replace").splitlines()
    try:
        return [Finding.of_row(parse_json(line)) for line in lines]
    except (ValueError, TypeError, KeyError):
        raise InputError(f"{path}: damaged; remove it, and give --overwrite always to check again") from None


def show_findings(findings: Sequence[Finding], strict: bool = False, console: Console = STDERR) -> None:
    """Print a table of findings, if there are any: errors first, then by subject; similar ones are counted.

    With `strict`, each of them stops its subject.
    """
    if not findings:
        return
    table = Table(title=summary(findings, strict), title_justify="left", title_style="bold", expand=False)
    for name in ("where", "check", "what follows"):
        table.add_column(name, no_wrap=name != "what follows", overflow="fold")
    table.add_column("finding", overflow="fold")

    def alike(found: Finding) -> tuple[int, str, str, str]:
        return CONSEQUENCES.index(found.consequence(strict)), found.subject, found.camera, found.check

    for _, group in groupby(sorted(findings, key=alike), alike):
        same = list(group)
        for place, found in enumerate(same[:_SHOWN_ALIKE], start=1):
            more = len(same) - _SHOWN_ALIKE if place == _SHOWN_ALIKE else 0
            words = one_line(found.words) + (f" (and {more} more like it)" if more else "")
            follows = found.consequence(strict)
            table.add_row(Text(found.place), Text(found.check), Text(follows, _STYLES[follows]), Text(words))
    wide = console if console.is_terminal else Console(file=console.file, width=_PLAIN_WIDTH)
    wide.print(table)


def summary(findings: Sequence[Finding], strict: bool = False) -> str:
    """Title of the table: counts by consequence."""
    kinds = [found.consequence(strict) for found in findings]
    words = ", ".join(f"{kinds.count(kind)} x {kind}" for kind in CONSEQUENCES if kind in kinds)
    return f"Findings about {counted(len({found.subject for found in findings}), 'subject')}: {words}"
