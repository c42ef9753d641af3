"""Findings of a capture's checks, each about a subject, a camera or one frame.

An error stops its subject, unless it `leaves_out` a frame: then the subject goes on without that frame. A
warning stops nothing.
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

Severity = Literal["error", "warning"]


@dataclass(frozen=True)
class Finding:
    """A fault, with a message that says what to do and the measured figures.

    An empty camera or light means all of them. `leaves_out` means that this frame alone is broken; camera and
    light are then given.
    """

    severity: Severity
    check: str  # name of the check, such as 'missing' or 'unlit'
    subject: str
    words: str
    camera: str = ""
    light: str = ""
    figures: Mapping[str, float | int | str] = field(default_factory=dict)
    leaves_out: bool = False

    @property
    def place(self) -> str:
        """Place of the fault, `subject/camera/light` as far as given."""
        return "/".join(name for name in (self.subject, self.camera, self.light) if name)

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


def stopping(findings: Iterable[Finding], strict: bool = False) -> list[Finding]:
    """Select the findings that stop their subject; with `strict` all do."""
    return [found for found in findings if strict or (found.severity == "error" and not found.leaves_out)]


def frames_left_out(findings: Iterable[Finding]) -> dict[str, set[str]]:
    """Collect the ids of the lights whose frames are left out, by camera."""
    broken: dict[str, set[str]] = {}
    for found in findings:
        if found.leaves_out:
            broken.setdefault(found.camera, set()).add(found.light)
    return broken
