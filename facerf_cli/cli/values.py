"""Values that verbs read from options: numbers, poses, directions of lights. Wrong ones exit 2."""

import math
import os.path
from pathlib import Path
from typing import Literal

from facerf_cli.errors import UsageError

MOST_LIGHTS = 4096
MOST_FRAMES = 9999
_LIGHTS_FILE_LIMIT_BYTES = 1 << 20
_DIRECTIONS_HELP = "give a number, 'az,el;az,el;...' in degrees, or a text file with az,el on each line"

_MOST_DIGITS = 9  # of a count; Python refuses to read thousands
_MOST_EV = 20.0
_TURNED_AWAY_DEG, _MOST_ROLL_DEG = 90.0, 180.0
Exposure = float | Literal["auto", "face"]  # EV, or the rule that chooses it
PoseDeg = tuple[float, float, float]


def numbers(text: str, forms: tuple[str, ...], option: str) -> list[float]:
    """Parse finite numbers separated by commas, as many as one of `forms` ("AZ,EL") has names."""
    try:
        values = [float(part) for part in text.split(",")]
    except ValueError:
        values = []
    if len(values) not in [form.count(",") + 1 for form in forms] or not all(map(math.isfinite, values)):
        kind = "numbers separated by commas" if "," in forms[0] else "a number"
        raise UsageError(f"{option} {text!r}: give {' or '.join(forms)}, {kind}")
    return values


def azel(text: str, forms: tuple[str, ...], option: str) -> list[float]:
    """Parse numbers that begin with azimuth and elevation in degrees; colours, if any, follow."""
    values = numbers(text, forms, option)
    if abs(values[1]) > 90:
        raise UsageError(f"{option} {text!r}: the elevation is out of range; give -90 (below) to 90 (above)")
    if min(values[2:], default=0) < 0:
        raise UsageError(f"{option} {text!r}: the colour is negative; give values from 0")
    return values


def is_sweep(text: str) -> bool:
    """True for `FROM:TO:N`, a value for each of N frames."""
    return ":" in text


def sweep(text: str, option: str) -> list[float]:
    """Parse degrees `FROM:TO:N`: N equal steps from FROM on, without TO, so that turns join."""
    try:
        start, end, count = numbers(text.replace(":", ","), ("FROM,TO,N",), option)
    except UsageError:
        count = 0.0
    if not (count.is_integer() and 1 <= count <= MOST_FRAMES):
        raise UsageError(f"{option} {text!r}: give degrees, or FROM:TO:N with N frames, as in 0:360:24")
    return [start + (end - start) * frame / count for frame in range(int(count))]


def parse_pose(text: str | None) -> PoseDeg | None:
    """Parse `YAW,PITCH,ROLL` in degrees; None stays None (the photo's own pose)."""
    if text is None:
        return None
    yaw_deg, pitch_deg, roll_deg = numbers(text, ("YAW,PITCH,ROLL",), "--pose")
    if max(abs(yaw_deg), abs(pitch_deg)) > _TURNED_AWAY_DEG or abs(roll_deg) > _MOST_ROLL_DEG:
        raise UsageError(
            f"--pose {text!r}: turns the face away; give yaw and pitch of -90 to 90, roll of -180 to 180"
        )
    return yaw_deg, pitch_deg, roll_deg


def parse_exposure(text: str) -> Exposure:
    """Parse `--exposure`: EV, or the rule that chooses it."""
    if text == "auto":
        return "auto"
    if text == "face":
        return "face"
    (ev,) = numbers(text, ("auto or face or EV",), "--exposure")
    if abs(ev) > _MOST_EV:
        raise UsageError(f"--exposure {text!r}: out of range; give {-_MOST_EV:g} to {_MOST_EV:g} EV")
    return ev


def parse_lights(text: str) -> int | list[tuple[float, float]]:
    """Parse `--lights`: the number of a uniform rig, or (azimuth, elevation) in degrees of each light.

    The text is a number, 'az,el;az,el', or a file of such lines.
    """
    if text.isdecimal():
        if not (len(text) <= _MOST_DIGITS and 1 <= int(text) <= MOST_LIGHTS):
            raise UsageError(f"--lights {text}: not a number of lights; give 1 to {MOST_LIGHTS}")
        return int(text)
    is_file = os.path.isfile(text)  # Path's own raises where a long list is no possible name
    pairs = _lines(Path(text)) if is_file else [part for part in text.split(";") if part.strip()]
    if not pairs or "," not in pairs[0]:
        raise UsageError(f"--lights {text!r}: {_DIRECTIONS_HELP}")
    if len(pairs) > MOST_LIGHTS:
        raise UsageError(f"--lights: {len(pairs)} lights; give {MOST_LIGHTS} at most")
    option = f"--lights {text}:" if is_file else "--lights"
    return [(values[0], values[1]) for values in (azel(pair, ("AZ,EL",), option) for pair in pairs)]


def _lines(path: Path) -> list[str]:
    """Read the lines of a text file that are neither empty nor comments."""
    try:
        with path.open(encoding="utf-8") as stream:
            text = stream.read(_LIGHTS_FILE_LIMIT_BYTES)
    except (OSError, UnicodeDecodeError) as error:
        raise UsageError(f"--lights {path}: cannot be read as text ({error}); give a text file") from None
    lines = (line.partition("#")[0].strip() for line in text.splitlines())
    return [",".join(line.replace(",", " ").split()) for line in lines if line]
