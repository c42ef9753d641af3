"""Light directions for a draft of stage.json, from a list of lights next to the images.

A list has lines `name x y z` or `x y z`, x to the image's right, y up, z toward the camera: an LP file of
reflectance transformation imaging, whose first line is the number of lines that follow, or a plain text file.
Vectors are normalised, because lists may also hold the positions of lights relative to the object.
"""

import math
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from facerf_cli.errors import InputError
from facerf_cli.files.regular import require_regular

LIST_SUFFIX, LIST_NAMES = ".lp", ("lights.txt", "light_directions.txt")
_LIMIT_BYTES = 4 << 20
_DIGITS = 6

Direction = list[float]  # unit vector toward the light
ListedLight = tuple[str, Direction]  # name of an image, empty in a list without names; direction of its light


def read_light_list(path: Path) -> list[ListedLight]:
    """Read a list of lights; InputError names the first wrong line."""
    require_regular(path)
    try:
        with path.open("rb") as stream:
            content = stream.read(_LIMIT_BYTES + 1)
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror or error}); check the file") from None
    if len(content) > _LIMIT_BYTES:
        raise InputError(f"{path}: too large for a list of lights; give lines `name x y z`")
    rows = (
        line.split("#")[0].replace(",", " ").strip() for line in content.decode(errors="replace").splitlines()
    )
    lines = [(number, row) for number, row in enumerate(rows, 1) if row]
    if lines and lines[0][1].isdecimal():
        lines = lines[1:]  # the number of lines
    return [_parse_line(path, number, row) for number, row in lines]


def _parse_line(path: Path, number: int, row: str) -> ListedLight:
    *name, x, y, z = fields if len(fields := row.rsplit(maxsplit=3)) > 2 else [""] * 3
    try:
        vector = np.array([float(x), float(y), float(z)])
    except ValueError:
        raise InputError(f"{path}: line {number} is wrong; give `name x y z`") from None
    length = float(np.linalg.norm(vector))
    if not 0 < length < math.inf:
        raise InputError(f"{path}: line {number} has no direction; give a finite vector other than 0")
    rounded = [round(float(value), _DIGITS) + 0.0 for value in vector / length]  # + 0.0 turns -0.0 into 0.0
    return "".join(name), rounded


def match_lights(
    listed: Sequence[ListedLight], light_ids: Sequence[str], light_of_stem: Mapping[str, str]
) -> dict[str, Direction]:
    """Assign listed directions to lights by name; a list without names goes by the order of the lights.

    `light_of_stem` maps the stem of an image's file name to its light.
    """
    if not any(name for name, _ in listed):
        pairs = zip(light_ids, listed, strict=True) if len(listed) == len(light_ids) else ()
        return {light: direction for light, (_, direction) in pairs}
    known = {**light_of_stem, **{light: light for light in light_ids}}
    found = {}
    for path, direction in listed:
        name = path.replace("\\", "/").split("/")[-1]
        light = known.get(name) or known.get(name.rpartition(".")[0])
        if light is not None:
            found[light] = direction
    return found
