"""Values that verbs read from options: numbers, poses, directions of light. Wrong ones exit 2."""

import math
import os.path
from pathlib import Path
from typing import TYPE_CHECKING

from facerf_cli.errors import UsageError

if TYPE_CHECKING:
    from torch import Tensor

MOST_LIGHTS = 4096
_LIGHTS_FILE_LIMIT_BYTES = 1 << 20
_DIRECTIONS_HELP = "give a number, 'az,el;az,el;...' in degrees, or a text file with az,el on each line"


def numbers(text: str, forms: tuple[str, ...], option: str) -> list[float]:
    """Finite numbers separated by commas, as many as one of `forms` ("AZ,EL") has names."""
    try:
        values = [float(part) for part in text.split(",")]
    except ValueError:
        values = []
    if len(values) not in [form.count(",") + 1 for form in forms] or not all(map(math.isfinite, values)):
        kind = "numbers with commas between them" if "," in forms[0] else "a number"
        raise UsageError(f"{option} {text!r}: give {' or '.join(forms)}, {kind}")
    return values


def azel(text: str, forms: tuple[str, ...], option: str) -> list[float]:
    """`numbers` that begin with azimuth and elevation in degrees; colours, if any, follow."""
    values = numbers(text, forms, option)
    if abs(values[1]) > 90:
        raise UsageError(f"{option} {text!r}: an elevation is from -90 (below) to 90 (above)")
    if min(values[2:], default=0) < 0:
        raise UsageError(f"{option} {text!r}: a light's colour is not negative")
    return values


def parse_pose(text: str | None) -> "Tensor | None":
    """`YAW,PITCH,ROLL` in degrees as head_to_camera [3, 3]; None stays None (the photo's own pose)."""
    from facerf_cli.raster.camera import pose_to_rotation

    if text is None:
        return None
    return pose_to_rotation(*numbers(text, ("YAW,PITCH,ROLL",), "--pose"))


def parse_directions(text: str) -> "Tensor":
    """`--lights`: unit directions [L, 3] of a rig of N, of 'az,el;az,el', or of a file of such lines."""
    import torch

    from facerf_cli.light.sphere import azel_to_direction, rig_directions

    if text.isdecimal():
        if not 1 <= int(text) <= MOST_LIGHTS:
            raise UsageError(f"--lights {text}: from 1 to {MOST_LIGHTS} lights can be had")
        return rig_directions(int(text))
    is_file = os.path.isfile(text)  # Path's own raises where a long list is no possible name
    pairs = _lines(Path(text)) if is_file else [part for part in text.split(";") if part.strip()]
    if not pairs or "," not in pairs[0]:
        raise UsageError(f"--lights {text!r}: {_DIRECTIONS_HELP}")
    if len(pairs) > MOST_LIGHTS:
        raise UsageError(f"--lights: {len(pairs)} lights; at most {MOST_LIGHTS} can be had")
    option = f"--lights {text}:" if is_file else "--lights"
    azimuth, elevation = torch.tensor([azel(pair, ("AZ,EL",), option) for pair in pairs]).T
    return azel_to_direction(azimuth, elevation)


def _lines(path: Path) -> list[str]:
    """The lines of a text file that are neither empty nor comments."""
    try:
        with path.open(encoding="utf-8") as stream:
            text = stream.read(_LIGHTS_FILE_LIMIT_BYTES)
    except (OSError, UnicodeDecodeError) as error:
        raise UsageError(f"--lights {path}: cannot be read as text ({error})") from None
    lines = (line.partition("#")[0].strip() for line in text.splitlines())
    return [",".join(line.replace(",", " ").split()) for line in lines if line]
