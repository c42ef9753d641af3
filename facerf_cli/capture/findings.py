"""Findings of a capture's checks, and selection of the frames for a subject's OLAT stacks.

An error stops its subject, unless it concerns one frame: then only that frame is left out. A warning stops
nothing.

All stacks of a subject contain the same lights, because pairs share the weights of an envmap between cameras.
So a light whose frame is missing or broken in one camera is left out for the subject. A camera that lacks
most of its frames is left out instead, so that the other cameras keep their lights.

A dataset's findings.jsonl has a row for every finding. findings/SUBJECT.jsonl, written before the subject is
prepared, keeps a subject's findings for later runs.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from itertools import chain, groupby
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
_LISTED = 6  # entries of a log line; the others are counted
FINDINGS_FILE, _FOLDER = "findings.jsonl", "findings"
_PLAIN_WIDTH = 160  # columns of a table in a log file


@dataclass(frozen=True)
class Finding:
    """Fault with its remedy in words and the measured figures; no camera or light means all of them."""

    severity: Severity
    check: str  # name of the check, such as 'missing' or 'order'
    subject: str
    words: str
    camera: str | None = None
    light: str | None = None
    figures: Mapping[str, float | int | str] = field(default_factory=dict)

    @property
    def leaves_out(self) -> bool:
        """Whether only one frame is broken, and left out."""
        return self.severity == "error" and bool(self.light)

    @property
    def place(self) -> str:
        """Place of the fault, `subject/camera/light` as far as known."""
        return "/".join(name for name in (self.subject, self.camera, self.light) if name)

    def consequence(self, strict: bool = False) -> str:
        """Return one of `CONSEQUENCES`; with `strict` a finding always stops its subject."""
        if self.leaves_out and not strict:
            return "frame left out"
        return "subject stopped" if strict or self.severity == "error" else "warning"

    def row(self) -> dict[str, Any]:
        """Return the row of findings.jsonl."""
        return {**asdict(self), "leaves_out": self.leaves_out}


def stopping(findings: Iterable[Finding], strict: bool = False) -> list[Finding]:
    """Select the findings that stop their subject; with `strict` all do."""
    return [finding for finding in findings if finding.consequence(strict) == "subject stopped"]


@dataclass(frozen=True)
class Selection:
    """Lights and cameras of a subject's stacks, with the reasons for each one that is left out."""

    lights: tuple[int, ...]  # indices into the capture's lights, ascending
    cameras: tuple[str, ...]
    left_out: dict[str, str] = field(default_factory=dict)  # reason by light id
    dropped: dict[str, str] = field(default_factory=dict)  # reason by camera id
    missing: tuple[str, ...] = ()  # "camera/light" of the frames that do not exist

    def in_words(self) -> str:
        """Return the log line about lights and cameras left out, except marked frames; empty if none is."""
        parts = []
        if lights := {light: why for light, why in self.left_out.items() if MARKED not in why}:
            parts.append(f"{counted(len(lights), 'light')} left out ({_list(lights)})")
        if self.dropped:
            parts.append(f"{counted(len(self.dropped), 'camera')} left out ({_list(self.dropped)})")
        return ", ".join(parts)


def select_frames(
    capture: Capture, subject: str, findings: Iterable[Finding] = (), strict: bool = False
) -> Selection:
    """Select the frames of a subject that exist and that no finding leaves out.

    Raises InputError for too few frames; with `strict`, also for a missing frame that is not marked as
    damaged.
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
    for finding in findings:
        if finding.camera in broken and finding.light and finding.leaves_out:
            broken[finding.camera].setdefault(finding.light, finding.check)
    rig = len(capture.light_ids)
    dropped = {
        camera: f"only {rig - len(lights)} of {rig} frames exist and are sound"
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
    """Return the first reasons, and the number of the others."""
    words = [f"{name}: {why}" for name, why in list(reasons.items())[:_LISTED]]
    more = len(reasons) - len(words)
    return "; ".join([*words, f"and {more} more"] if more else words)


def has_new_frames(capture: Capture, subject: str, missing: Iterable[str]) -> bool:
    """Return whether a frame of `Selection.missing` exists now."""
    frames = (name.split("/") for name in missing)
    return any(capture.frame_path(subject, camera, light).is_file() for camera, light in frames)


def require_sound(subject: str, findings: Iterable[Finding], strict: bool) -> None:
    """Raise InputError if findings stop the subject."""
    if at_fault := stopping(findings, strict):
        first = at_fault[0]
        more = f" ({len(at_fault)} such findings, see {FINDINGS_FILE})" if len(at_fault) > 1 else ""
        advice = "" if first.severity == "error" else "; without --strict it is a warning"
        raise InputError(f"{first.place}: {first.check}: {first.words}{advice}{more}")


def write_findings(path: Path, findings: Iterable[Finding]) -> None:
    with atomic_path(path) as temporary:
        rows = (json_line(finding.row()) + "\n" for finding in findings)
        temporary.write_text("".join(rows), encoding="utf-8")


def keep_findings(folder: Path, subject: str, findings: Sequence[Finding]) -> None:
    """Write a subject's findings into a dataset's folder; remove the file if there are none."""
    path = folder / _FOLDER / f"{subject}.jsonl"
    if findings:
        write_findings(path, findings)
    else:
        path.unlink(missing_ok=True)


def collect_findings(folder: Path, subjects: Iterable[str]) -> dict[str, list[Finding]]:
    """Write findings.jsonl from all subjects' files; return the findings by subject.

    Raises InputError for a damaged file.
    """
    findings = {}
    for subject in subjects:
        path = folder / _FOLDER / f"{subject}.jsonl"
        if not path.is_file():
            continue
        rows = text_of(path.read_bytes(), "replace").splitlines()
        try:
            findings[subject] = [_parse(row) for row in rows]
        except (ValueError, TypeError, KeyError):
            advice = "remove it, and pass --overwrite always to check again"
            raise InputError(f"{path}: damaged; {advice}") from None
    write_findings(folder / FINDINGS_FILE, chain.from_iterable(findings.values()))
    return findings


def _parse(row: str) -> Finding:
    values = parse_json(row)
    del values["leaves_out"]
    return Finding(**values)


def show_findings(findings: Sequence[Finding], strict: bool = False, console: Console = STDERR) -> None:
    """Print a table of findings, if there are any: errors first, then by subject; similar ones in one row.

    With `strict`, each of them stops its subject.
    """
    if not findings:
        return
    kinds = [finding.consequence(strict) for finding in findings]
    counts = ", ".join(f"{kinds.count(kind)} x {kind}" for kind in CONSEQUENCES if kind in kinds)
    subjects = counted(len({finding.subject for finding in findings}), "subject")
    table = Table(title=f"Findings about {subjects}: {counts}", title_justify="left", title_style="bold")
    for name in ("where", "check", "consequence"):
        table.add_column(name, no_wrap=name != "consequence", overflow="fold")
    table.add_column("finding", overflow="fold")

    def key(finding: Finding) -> tuple[int, str, str, str]:
        consequence = CONSEQUENCES.index(finding.consequence(strict))
        return consequence, finding.subject, finding.camera or "", finding.check

    for (consequence, *_), group in groupby(sorted(findings, key=key), key):
        first, *others = group
        words = one_line(first.words) + f" (and {len(others)} more like it)" * bool(others)
        result = CONSEQUENCES[consequence]
        styled = Text(result, "yellow" if result == "warning" else "red")
        table.add_row(Text(first.place), Text(first.check), styled, Text(words))
    wide = console if console.is_terminal else Console(file=console.file, width=_PLAIN_WIDTH)
    wide.print(table)
