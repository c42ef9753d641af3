"""Which frames go into stacks: missing, broken, marked ones are left out, and it is said what that costs."""

import re
from pathlib import Path

import pytest

from facerf_cli.capture.capture import Capture
from facerf_cli.capture.findings import Finding, Severity, has_new_frames, select_frames
from facerf_cli.capture.yale_b import Flash, read_yale_capture
from facerf_cli.errors import InputError
from tests.capture.yale_fixture import write_yale_b

FLASHES = tuple(Flash(azimuth_deg, 10) for azimuth_deg in range(-60, 61, 10))  # 13


@pytest.fixture
def capture(tmp_path: Path) -> Capture:
    return read_yale_capture(write_yale_b(tmp_path, flashes=FLASHES))


def broken(light: str, severity: Severity = "error") -> Finding:
    return Finding(severity, "fields", "yaleB05", "is dark", "P00", light)


def test_everything_is_there_but_nobody_is_left_without_frames(capture: Capture) -> None:
    chosen = select_frames(capture, "yaleB05", strict=True)
    assert chosen.lights == tuple(range(13)) and chosen.cameras == ("P00",)
    assert not chosen.in_words() and not chosen.left_out and not chosen.missing
    for light in capture.light_ids[:8]:
        capture.frame_path("yaleB07", "P00", light).unlink()
    with pytest.raises(InputError, match=r"no camera has enough frames .P00: only 5 of 13"):
        select_frames(capture, "yaleB07")


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
        woven: "P00: fields",
    }
    assert chosen.in_words() == f"2 lights left out ({missing}: P00: missing; {woven}: P00: fields)"
    assert chosen.missing == (f"P00/{missing}", f"P00/{marked}")
    with pytest.raises(InputError, match=r"yaleB05: 9 of 13 lights .* too few"):
        select_frames(capture, "yaleB05", [*findings, broken(another)])
    with pytest.raises(InputError, match=f"yaleB05/P00/{re.escape(missing)}: missing .*strict"):
        select_frames(capture, "yaleB05", strict=True)
    assert not has_new_frames(capture, "yaleB05", chosen.missing)
    gone.write_bytes(content)
    assert has_new_frames(capture, "yaleB05", chosen.missing)
    select_frames(capture, "yaleB05", strict=True)  # what is marked is known
