"""Where lamps stand, as the names of pictures say it, or a list of lights beside them.

Lists are of lines `name x y z` or `x y z`, x to the picture's right, y up and z toward the camera: the LP
files of reflectance transformation imaging, whose first line is how many follow, and plain text files. What
is no unit vector is made one, for lists also give lamps' places, seen from the object.
"""

import math
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from facerf_cli.errors import InputError
from facerf_cli.light.sphere import azel_to_direction

LIST_SUFFIX, LIST_NAMES = ".lp", ("lights.txt", "light_directions.txt")
# A+035E-20, az35_el-20, azimuth_35_elevation_-20: letters alone stand for angles only before a sign.
ANGLES = re.compile(
    r"(?<![^\W\d_])(?:a(?=[+-])|az(?:imuth)?)[_=]?(?P<azimuth>[+-]?[0-9]{1,3}(?:\.[0-9]+)?)[_, -]?"
    r"(?:e(?=[+-])|el(?:ev(?:ation)?)?)[_=]?(?P<elevation>[+-]?[0-9]{1,3}(?:\.[0-9]+)?)",
    re.IGNORECASE,
)
_LIMIT_BYTES = 4 << 20
_DIGITS = 6

Direction = list[float]  # a unit vector toward the lamp


@dataclass(frozen=True)
class Lamp:
    """A line of a list: the picture's name, empty where the list has none, and where its lamp stands."""

    name: str
    direction: Direction
    length: float  # of the vector that is given


def direction_in_name(name: str) -> Direction | None:
    """Where a name's azimuth and elevation point, by DESIGN's `az,el`: az > 0 is to the picture's right."""
    match = ANGLES.search(name)
    if match is None:
        return None
    azimuth_deg, elevation_deg = np.float64(match["azimuth"]), np.float64(match["elevation"])
    if abs(azimuth_deg) > 360 or abs(elevation_deg) > 90:
        return None
    return _rounded(azel_to_direction(azimuth_deg, elevation_deg).tolist())


def read_lamps(path: Path) -> list[Lamp]:
    """The lines of a list of lights; an InputError names the first that is none."""
    try:
        with path.open("rb") as stream:
            content = stream.read(_LIMIT_BYTES + 1)
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror or error})") from None
    if len(content) > _LIMIT_BYTES:
        raise InputError(f"{path}: too large for a list of lights")
    rows = (
        line.split("#")[0].replace(",", " ").strip() for line in content.decode(errors="replace").splitlines()
    )
    lines = [(number, row) for number, row in enumerate(rows, 1) if row]
    if lines and lines[0][1].isdecimal():
        lines = lines[1:]  # how many follow
    return [_lamp(path, number, row) for number, row in lines]


def _lamp(path: Path, number: int, row: str) -> Lamp:
    *name, x, y, z = fields if len(fields := row.rsplit(maxsplit=3)) > 2 else [""] * 3
    try:
        vector = np.array([float(x), float(y), float(z)])
    except ValueError:
        raise InputError(f"{path}: line {number} is not `name x y z`") from None
    length = float(np.linalg.norm(vector))
    if not 0 < length < math.inf:
        raise InputError(f"{path}: line {number} points nowhere")
    return Lamp("".join(name), _rounded(vector / length), length)


def by_light(
    lamps: Sequence[Lamp], light_ids: Sequence[str], light_of_stem: Mapping[str, str]
) -> dict[str, Direction]:
    """Directions by light: by the pictures' names; a list without names goes by the lights' order.

    `light_of_stem` has the light of a picture by its file's name without suffix.
    """
    if all(not lamp.name for lamp in lamps):
        pairs = zip(light_ids, lamps, strict=True) if len(lamps) == len(light_ids) else ()
        return {light: lamp.direction for light, lamp in pairs}
    known = {**light_of_stem, **{light: light for light in light_ids}}
    found = {}
    for lamp in lamps:
        name = lamp.name.replace("\\", "/").split("/")[-1]
        light = known.get(name) or known.get(name.rpartition(".")[0])
        if light is not None:
            found[light] = lamp.direction
    return found


def _rounded(vector: Iterable[float]) -> Direction:
    return [round(float(value), _DIGITS) + 0.0 for value in vector]  # + 0.0: no minus before a zero
