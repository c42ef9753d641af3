"""What the checks of a capture say: findings, each about a subject, a camera or one frame.

An error stops its subject, unless it `leaves_out` a frame: then the frame alone is to be left out of the
stack, and the subject goes on without it. A warning stops nothing.
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

Severity = Literal["error", "warning"]


@dataclass(frozen=True)
class Finding:
    """One thing that is wrong, in words that say what to do, with the figures that show it.

    An empty camera or light means all of them. `leaves_out`: the frame (camera and light are given) is broken
    and the rest of the subject is sound.
    """

    severity: Severity
    check: str  # the name of the check, 'missing', 'unlit' and so on
    subject: str
    words: str
    camera: str = ""
    light: str = ""
    figures: Mapping[str, float | int | str] = field(default_factory=dict)
    leaves_out: bool = False

    @property
    def place(self) -> str:
        """Where it is, `subject/camera/light` as far as they are given."""
        return "/".join(name for name in (self.subject, self.camera, self.light) if name)

    def row(self) -> dict[str, Any]:
        """As a row of findings.jsonl."""
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
    """Those that stop their subject; with `strict` any finding does."""
    return [found for found in findings if strict or (found.severity == "error" and not found.leaves_out)]


def frames_left_out(findings: Iterable[Finding]) -> dict[str, set[str]]:
    """By camera, the ids of the lights whose frames are broken."""
    broken: dict[str, set[str]] = {}
    for found in findings:
        if found.leaves_out:
            broken.setdefault(found.camera, set()).add(found.light)
    return broken
