"""Which frames go into stacks: missing, broken, marked ones are left out, and it is said what that costs."""

import io
import re
from pathlib import Path

import pytest
from rich.console import Console

from facerf_cli.capture.capture import Capture
from facerf_cli.capture.findings import (
    Finding,
    Severity,
    has_new_frames,
    select_frames,
    show_findings,
)
from facerf_cli.capture.yale_b import Flash, read_yale_capture
from facerf_cli.errors import InputError
from tests.capture.yale_fixture import write_yale_b
from tests.refusals import refused

FLASHES = tuple(Flash(azimuth_deg, 10) for azimuth_deg in range(-60, 61, 10))  # 13


@pytest.fixture
def capture(tmp_path: Path) -> Capture:
    return read_yale_capture(write_yale_b(tmp_path, flashes=FLASHES))


def broken(light: str, severity: Severity = "error") -> Finding:
    return Finding(severity, "black", "yaleB05", "is dark", "P00", light)


def test_everything_is_there_but_nobody_is_left_without_frames(capture: Capture) -> None:
    chosen = select_frames(capture, "yaleB05", strict=True)
    assert chosen.lights == tuple(range(13)) and chosen.cameras == ("P00",)
    assert not chosen.in_words() and not chosen.left_out and not chosen.missing
    for light in capture.light_ids[:8]:
        capture.frame_path("yaleB07", "P00", light).unlink()
    refused(InputError, "no camera has enough frames (P00: only 5 of 13", select_frames, capture, "yaleB07")


def test_broken_missing_and_marked_frames_are_left_out(capture: Capture) -> None:
    missing, marked, woven, sound, another = capture.light_ids[1:6]
    gone, bad = (capture.frame_path("yaleB05", "P00", light) for light in (missing, marked))
    content = gone.read_bytes()
    gone.unlink()
    bad.rename(bad.with_name(bad.name + ".bad"))
    capture = read_yale_capture(capture.folder)
    assert capture.marked == {"yaleB05": frozenset({marked})} and len(capture.light_ids) == 13
    findings = [broken(woven), broken(sound, "warning")]
    chosen = select_frames(capture, "yaleB05", findings)
    assert chosen.lights == (0, *range(4, 13))
    assert chosen.left_out == {
        missing: "P00: missing",
        marked: "P00: marked as damaged",
        woven: "P00: black",
    }
    assert chosen.in_words() == f"2 lights left out ({missing}: P00: missing; {woven}: P00: black)"
    assert chosen.missing == (f"P00/{missing}", f"P00/{marked}")
    refused(InputError, "yaleB05: 9 of 13", select_frames, capture, "yaleB05", [*findings, broken(another)])
    with pytest.raises(InputError, match=f"yaleB05/P00/{re.escape(missing)}: missing .*strict"):
        select_frames(capture, "yaleB05", strict=True)
    assert not has_new_frames(capture, "yaleB05", chosen.missing)
    gone.write_bytes(content)
    assert has_new_frames(capture, "yaleB05", chosen.missing)
    select_frames(capture, "yaleB05", strict=True)  # what is marked is known


STOPS = Finding("error", "rig", "0001", "the lights\nare mirrored [left] to right", "C0")
WARNS = Finding("warning", "motion", "0000", "the head moves", "C0")
FIELDS = [Finding("error", "black", "0000", f"has {k} values", "C0", f"L{k:03d}") for k in range(9)]


def shown(findings: list[Finding], width: int = 200, strict: bool = False) -> str:
    console = Console(file=io.StringIO(), width=width)
    show_findings(findings, strict, console)
    return console.file.getvalue()  # type: ignore[attr-defined]


def test_a_report_counts_what_is_alike_and_begins_with_what_stops_a_subject() -> None:
    assert shown([]) == ""
    text = shown([WARNS, *FIELDS, STOPS])
    assert "2 subjects: 1 x subject stopped, 9 x frame left out, 1 x warning" in text
    assert text.index("subject stopped", text.index("0001/C0")) < text.index("0000/C0/L000")
    assert text.index("0000/C0/L000") < text.index("the head moves")
    assert "are mirrored [left] to right" in text  # brackets are no markup
    assert "the lights are mirrored [left] to right" in shown([STOPS], width=60)
    assert "warning" not in shown([WARNS, *FIELDS, STOPS], strict=True)
    assert "left out" not in shown(FIELDS, strict=True)
    text = shown(FIELDS)
    assert "0000/C0/L000" in text and "L001" not in text and "(and 8 more like it)" in text
