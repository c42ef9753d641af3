"""The findings of a capture's checks as people read them: a table, like findings put together.

What `prepare-dataset` does with the findings of a capture's checks: stop a subject, tell, write down.

A dataset's findings.jsonl has them all; findings/SUBJECT.jsonl each subject's, where it has any, written
before the subject is worked on.

What `facerf prepare-dataset` does with one subject of a capture: check, choose, prepare.
"""

import logging
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from rich.console import Console
from rich.table import Table
from rich.text import Text

from facerf_cli.cli.batch import Item, Outcome
from facerf_cli.cli.options import Settings, workers_of
from facerf_cli.errors import InputError, UsageError
from facerf_cli.logs import LOGGER_NAME, STDERR, counted, json_line, one_line
from facerf_cli.workers import process_died, spread

if TYPE_CHECKING:
    from facerf_cli.capture.capture import Capture
    from facerf_cli.capture.checks.findings import Finding
    from facerf_cli.capture.colour_correction import ChartCorrection
    from facerf_cli.capture.select import Selection
    from facerf_cli.face.morphable import MorphableModel

_ALIKE = 3  # findings of one check in a camera that are shown; the rest are counted
_STYLES = {"error": "red", "warning": "yellow"}
_PLAIN_WIDTH = 160  # of a log file, which has no width of its own

Row = Mapping[str, Any]  # as `Finding.row` makes it


def show_findings(rows: Sequence[Row], strict: bool = False, console: Console = STDERR) -> None:
    """Print the rows as a table, if there are any; findings.jsonl has all of them, here like ones are cut.

    With `strict` each of them stops its subject.
    """
    if strict:
        rows = [{**row, "severity": "error", "leaves_out": False} for row in rows]
    if rows:
        wide = console if console.is_terminal else Console(file=console.file, width=_PLAIN_WIDTH)
        wide.print(findings_table(rows))


def findings_table(rows: Sequence[Row]) -> Table:
    """Errors first, then by subject; of many alike the first few, and how many more."""
    table = Table(title=summary(rows), title_justify="left", title_style="bold", expand=False)
    for name in ("where", "check", "what follows"):
        table.add_column(name, no_wrap=name != "what follows", overflow="fold")
    table.add_column("finding", overflow="fold")
    for row, more in _shortened(rows):
        words = one_line(str(row["words"])) + (f" (and {more} more like it)" if more else "")
        where = "/".join(str(row[key]) for key in ("subject", "camera", "light") if row.get(key))
        style = _STYLES.get(str(row["severity"]), "")
        table.add_row(Text(where), Text(str(row["check"])), Text(follows(row), style), Text(words))
    return table


def follows(row: Row) -> str:
    """What a finding means for the subject."""
    if row["leaves_out"]:
        return "frame left out"
    return "subject stopped" if row["severity"] == "error" else "warning"


def summary(rows: Sequence[Row]) -> str:
    """One line over the table."""
    subjects = len({row["subject"] for row in rows})
    kinds = [follows(row) for row in rows]
    counts = ((kinds.count(kind), kind) for kind in ("subject stopped", "frame left out", "warning"))
    words = ", ".join(f"{count} x {kind}" for count, kind in counts if count)
    return f"Findings about {counted(subjects, 'subject')}: {words}"


def _shortened(rows: Sequence[Row]) -> Iterator[tuple[Row, int]]:
    """The first few rows of each check in a camera, the last of them with how many were left away."""
    groups: dict[tuple[Any, ...], list[Row]] = {}
    for row in rows:
        key = (follows(row) == "warning", row["leaves_out"], row["subject"], row.get("camera"), row["check"])
        groups.setdefault((*key[:3], key[3] or "", key[4]), []).append(row)
    for key in sorted(groups):
        group = groups[key]
        for place, row in enumerate(group[:_ALIKE], start=1):
            yield row, len(group) - _ALIKE if place == _ALIKE else 0


FINDINGS_FILE, _FOLDER = "findings.jsonl", "findings"
_ROWS_LIMIT_BYTES = 256 << 20
log = logging.getLogger(LOGGER_NAME)


def check(capture: "Capture", subject: str) -> "list[Finding]":
    """Findings about a subject's frames, less those that the capture itself gives up.

    What the camera saw is looked at, before a colour chart's matrix hides which channel was clipped.
    """
    from facerf_cli.capture.checks.subject import check_subject

    marked = capture.marked.get(subject, frozenset())
    return [
        found
        for found in check_subject(replace(capture, charts=()), subject)
        if not (found.check == "missing" and found.light in marked)
    ]


def require_sound(subject: str, findings: "Iterable[Finding]", strict: bool) -> None:
    """An InputError where findings stop the subject."""
    from facerf_cli.capture.checks.findings import stopping

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

    from facerf_cli.capture.checks.findings import stopping

    shown = STDERR.is_terminal and settings.verbosity >= 0 and not settings.log_json
    results = spread(work, items, workers_of(settings, jobs), _died)
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
        from facerf_cli.synth.heads_bank import one_thread

        with one_thread():
            return check(self.opened(), item.name)


def _died(item: Item, error: Exception) -> "list[Finding]":
    from facerf_cli.capture.checks.findings import Finding

    return [Finding("error", "unchecked", item.name, process_died(error))]


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


Checks = Literal["on", "off", "only"]


@dataclass(frozen=True)
class Given:
    """Which capture, and how it is read; settings only."""

    folder: Path
    layout: str
    subtract_ambient: bool
    align: bool
    charts: "tuple[ChartCorrection, ...]" = ()

    def opened(self) -> "Capture":
        """The capture's description, read once a process; it is an input of the whole run."""
        capture = _capture(self.folder, self.layout, self.subtract_ambient, self.align)
        return replace(capture, charts=self.charts)


@dataclass(frozen=True)
class Prepare:
    """Prepares one subject; settings only."""

    given: Given
    checks: Checks
    strict: bool
    face_model: str
    crop_px: int
    folder: Path
    key: str

    def outputs_of(self, item: Item) -> list[Path]:
        """A subject's files."""
        from facerf_cli.dataset.prepare import subject_outputs

        return subject_outputs(self.given.opened(), item.name, self.folder)

    def __call__(self, item: Item) -> Outcome:
        """Prepare a subject, on one thread, so that its bytes do not depend on how many there are."""
        from facerf_cli.dataset.prepare import prepare_subject
        from facerf_cli.synth.heads_bank import one_thread

        model = face_model_of(self.face_model)
        with one_thread():
            capture, chosen = self._choose(item.name)
            record = prepare_subject(
                capture, item.name, chosen, model, self.folder, self.crop_px, self.key, self.strict
            )
        if record["quality"] == "poor":
            log.warning("%s: the fit is poor; look at sheets/%s.jpg", item.input_path, item.name)
        worst = max(entry["crop_off_iod"] for entry in record["cameras"].values())
        facts = {name: record[name] for name in ("error_iod", "quality", "faces_found")}
        facts |= {"cameras": len(record["cameras"]), "worst_crop_off_iod": worst}
        facts |= {"lights": len(chosen.lights)}
        return Outcome(self.outputs_of(item), facts)

    def _choose(self, subject: str) -> "tuple[Capture, Selection]":
        """The capture, aligned on request, and its sound frames; an InputError where those are too few."""
        from facerf_cli.capture.checks.findings import frames_left_out
        from facerf_cli.capture.checks.motion import with_alignment
        from facerf_cli.capture.select import select_frames

        capture = self.given.opened()
        findings = check(capture, subject) if self.checks == "on" else []
        write_findings(self.folder, subject, findings)
        require_sound(subject, findings, self.strict)
        chosen = select_frames(capture, subject, findings, self.strict)
        if capture.align:
            capture = with_alignment(capture, subject, frames_left_out(findings))
        return capture, chosen


@cache
def _capture(folder: Path, layout: str, subtract_ambient: bool, align: bool) -> "Capture":
    from facerf_cli.capture.layouts import read_capture

    try:
        return read_capture(folder, layout, subtract_ambient, align)
    except InputError as error:
        raise UsageError(str(error)) from None


@cache
def face_model_of(name: str) -> "MorphableModel":
    """The face model, once a process."""
    from facerf_cli.face.morphable import load_face_model

    return load_face_model(name)
