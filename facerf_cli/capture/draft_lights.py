"""What the headers of a capture's pictures say of its cameras: sizes, and a colour space if it is plain.

Where lamps stand, as the names of pictures say it, or a list of lights beside them.

Lists are of lines `name x y z` or `x y z`, x to the picture's right, y up and z toward the camera: the LP
files of reflectance transformation imaging, whose first line is how many follow, and plain text files. What
is no unit vector is made one, for lists also give lamps' places, seen from the object.
"""

import math
import re
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from facerf_cli.colour import LINEAR, find_space
from facerf_cli.errors import InputError
from facerf_cli.files.images import Header, read_header
from facerf_cli.light.sphere import azel_to_direction

_HEADERS = 12  # that are read a camera, of pictures all over the capture
_FOCAL = 4  # times the longer side: DESIGN's crop camera, and about what stages use
_DISPLAY_SUFFIXES = (".png", ".jpg", ".jpeg", ".webp")  # of 8 bits a value, these are sRGB but for a profile

# To OpenCV's axes (y down, z forward) from DESIGN's camera space (y up, z toward the camera).
FACING = [[1.0, 0.0, 0.0, 0.0], [0.0, -1.0, 0.0, 0.0], [0.0, 0.0, -1.0, 0.0]]


@dataclass(frozen=True)
class Sight:
    """What the headers of a camera's pictures have, and how many: sizes (width, height), colour spaces."""

    sizes: Counter[tuple[int, int]]
    spaces: Counter[str | None]  # None where the header does not tell
    nameless: int  # that have primaries of no space known here
    unread: int


def look_at(paths: Sequence[Path]) -> Sight:
    """Read some of the headers of a camera's pictures."""
    step = max(len(paths) // _HEADERS, 1)
    headers = [(path, read_header(path)) for path in paths[::step][:_HEADERS]]
    read = [(path, header) for path, header in headers if header is not None]
    return Sight(
        Counter((header.width_px, header.height_px) for _, header in read),
        Counter(_space_name(path, header) for path, header in read),
        sum(find_space(header.space.name) is None for _, header in read),
        len(headers) - len(read),
    )


def _space_name(path: Path, header: Header) -> str | None:
    """The name that `stage.json` has for it; None for a space without one, and where it would be a guess."""
    if not header.is_floating and (header.bits > 8 or path.suffix.lower() not in _DISPLAY_SUFFIXES):
        return None
    if header.space == LINEAR:
        return "lin_rec709"
    return header.space.name if find_space(header.space.name) == header.space else None


def describe_camera(name: str, sight: Sight, alone: bool) -> dict[str, object]:
    """A camera's entry in stage.json: a K that is a guess; where it is `alone`, it is the world."""
    width, height = sight.sizes.most_common(1)[0][0] if sight.sizes else (None, None)
    k = None
    if width and height:
        focal = float(_FOCAL * max(width, height))
        k = [[focal, 0.0, width / 2], [0.0, focal, height / 2], [0.0, 0.0, 1.0]]
    pose = FACING if alone else None
    return {"id": name, "width": width, "height": height, "K": k, "world_to_camera": pose}


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
