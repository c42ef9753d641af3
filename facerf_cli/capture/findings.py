"""Findings of a capture's checks, and the frames that go into a subject's OLAT stacks.

An error stops its subject, unless it is about one frame: then the subject goes on without that frame. A
warning stops nothing.

All stacks of a subject hold the same lights, because pairs share the weights of an envmap between cameras. So
a light whose frame is missing or broken in one camera is left out for the subject; a camera that lacks most
of its frames is left out as a whole instead, so that the other cameras keep their lights.

A dataset's findings.jsonl has a row for every finding; findings/SUBJECT.jsonl has those of a subject, written
before the subject is prepared.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import groupby
from pathlib import Path
from typing import Any, Literal

from rich.console import Console
from rich.table import Table
from rich.text import Text

from facerf_cli.capture.capture import Capture
from facerf_cli.errors import InputError
from facerf_cli.files.atomic import atomic_path
from facerf_cli.files.texts import parse_json, text_of
from facerf_cli.run.logs import STDERR, counted, json_line, one_line

Severity = Literal["error", "warning"]
LEAST_LIGHTS, LEAST_SHARE = 10, 0.5  # lights, and share of the rig's, that a usable OLAT stack has
MISSING, MARKED = "missing", "marked as damaged"
CONSEQUENCES = ("subject stopped", "frame left out", "warning")
_LISTED = 6  # entries of a log line; the rest are counted
FINDINGS_FILE, _FOLDER = "findings.jsonl", "findings"
_SHOWN_ALIKE = 3  # findings of one check in a camera; the table counts the rest
_STYLES = dict(zip(CONSEQUENCES, ("red", "red", "yellow"), strict=True))
_PLAIN_WIDTH = 160  # of a log file, which has no width


@dataclass(frozen=True)
class Finding:
    """A fault, with a message that says what to do and the measured figures.

    An empty camera or light means all of them.
    """

    severity: Severity
    check: str  # name of the check, such as 'missing' or 'order'
    subject: str
    words: str
    camera: str = ""
    light: str = ""
    figures: Mapping[str, float | int | str] = field(default_factory=dict)

    @property
    def leaves_out(self) -> bool:
        """True if this frame alone is broken, and left out."""
        return self.severity == "error" and bool(self.light)

    @property
    def place(self) -> str:
        """Place of the fault, `subject/camera/light` as far as given."""
        return "/".join(name for name in (self.subject, self.camera, self.light) if name)

    def consequence(self, strict: bool = False) -> str:
        """Return one of `CONSEQUENCES`; with `strict` a finding always stops its subject."""
        if self.leaves_out and not strict:
            return "frame left out"
        return "subject stopped" if strict or self.severity == "error" else "warning"

    def row(self) -> dict[str, Any]:
        """Row of findings.jsonl."""
        return {
            "severity": self.severity,
            "check": self.check,
            "subject": self.subject,
            "camera": self.camera or None,
            "light": self.light or None,
            "leaves_out": self.leaves_out,
            "words": self.words,
            "figures": dict(self.figures),
        }

    @staticmethod
    def of_row(row: Mapping[str, Any]) -> "Finding":
        """Read a row of findings.jsonl."""
        names = ("severity", "check", "subject", "words", "camera", "light")
        known: dict[str, Any] = {name: row[name] or "" for name in names}
        return Finding(**known, figures=row["figures"])


def stopping(findings: Iterable[Finding], strict: bool = False) -> list[Finding]:
    """Select the findings that stop their subject; with `strict` all do."""
    return [found for found in findings if found.consequence(strict) == "subject stopped"]


@dataclass(frozen=True)
class Selection:
    """Lights and cameras of a subject's stacks, and the reasons for what is left out."""

    lights: tuple[int, ...]  # indices into the capture's lights, ascending
    cameras: tuple[str, ...]
    left_out: dict[str, str] = field(default_factory=dict)  # reason by light id
    dropped: dict[str, str] = field(default_factory=dict)  # reason by camera id
    missing: tuple[str, ...] = ()  # "camera/light" of the frames that do not exist

    def in_words(self) -> str:
        """Log line about what is left out, except marked frames; empty where nothing is."""
        parts = []
        if lights := {light: why for light, why in self.left_out.items() if MARKED not in why}:
            parts.append(f"{counted(len(lights), 'light')} left out ({_list(lights)})")
        if self.dropped:
            parts.append(f"{counted(len(self.dropped), 'camera')} left out ({_list(self.dropped)})")
        return ", ".join(parts)


def select_frames(
    capture: Capture, subject: str, findings: Iterable[Finding] = (), strict: bool = False
) -> Selection:
    """Select the frames of a subject that exist and that no finding leaves out; InputError for too few.

    With `strict`, a missing frame that is not marked as damaged is an InputError too.
    """
    marked = capture.marked.get(subject, frozenset())
    broken = {  # by camera, reasons by light whose frame does not exist
        camera: {
            light: MARKED if light in marked else MISSING
            for light in capture.light_ids
            if not capture.has_frame(subject, camera, light)
        }
        for camera in capture.cameras
    }
    missing = {f"{camera}/{light}": why for camera, lights in broken.items() for light, why in lights.items()}
    if strict and (unmarked := [name for name, why in missing.items() if why == MISSING]):
        first = f"{subject}/{unmarked[0]}"
        raise InputError(f"{first}: missing ({len(unmarked)} such frames); without --strict it is left out")
    for found in findings:
        if found.leaves_out and found.camera in broken:
            broken[found.camera].setdefault(found.light, found.check)
    rig = len(capture.light_ids)
    dropped = {
        camera: f"only {rig - len(lights)} of {rig} frames are there and sound"
        for camera, lights in broken.items()
        if len(lights) > (1 - LEAST_SHARE) * rig
    }
    cameras = tuple(camera for camera in capture.cameras if camera not in dropped)
    if not cameras:
        raise InputError(f"{subject}: no camera has enough frames ({_list(dropped)}); add the frames")
    left_out = {
        light: ", ".join(f"{camera}: {broken[camera][light]}" for camera in lacking)
        for light in capture.light_ids
        if (lacking := [camera for camera in cameras if light in broken[camera]])
    }
    kept = tuple(place for place, light in enumerate(capture.light_ids) if light not in left_out)
    if left_out and len(kept) < max(LEAST_SHARE * rig, min(LEAST_LIGHTS, rig)):
        raise InputError(
            f"{subject}: {len(kept)} of {rig} lights have a sound frame in every camera, which is too few "
            f"({_list(left_out)}); add the frames, or take a camera out of the capture"
        )
    return Selection(kept, cameras, left_out, dropped, tuple(missing))


def _list(reasons: Mapping[str, str]) -> str:
    """The first reasons, and the number of the others."""
    words = [f"{name}: {why}" for name, why in list(reasons.items())[:_LISTED]]
    more = len(reasons) - len(words)
    return "; ".join([*words, f"and {more} more"] if more else words)


def has_new_frames(capture: Capture, subject: str, missing: Iterable[str]) -> bool:
    """Tell whether a frame of `Selection.missing` exists by now."""
    frames = (name.split("/") for name in missing)
    return any(capture.frame_path(subject, camera, light).is_file() for camera, light in frames)


def require_sound(subject: str, findings: Iterable[Finding], strict: bool) -> None:
    """Raise InputError where findings stop the subject."""
    if at_fault := stopping(findings, strict):
        first = at_fault[0]
        more = f" ({len(at_fault)} such findings, see {FINDINGS_FILE})" if len(at_fault) > 1 else ""
        advice = "" if first.severity == "error" else "; without --strict it is a warning"
        raise InputError(f"{first.place}: {first.check}: {first.words}{advice}{more}")


def write_findings(path: Path, findings: Iterable[Finding]) -> None:
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
