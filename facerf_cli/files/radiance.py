"""Radiance's .hdr files: what their header says beyond OpenImageIO's reader, and the older run-length form.

A header of lines `NAME=value` ends with an empty line and the resolution, `-Y 512 +X 1024`. EXPOSURE and
COLORCORR, of which there may be several, have multiplied the values.
"""

from collections import defaultdict
from pathlib import Path
from typing import NamedTuple

import numpy as np
import OpenImageIO as oiio

from facerf_cli.errors import InputError
from facerf_cli.run import memory

_LIMIT_BYTES = 1 << 16  # of a header
# The Exif orientation of each order of the axes: the first is that of rows in the file.
_ORIENTATIONS = {
    order: number
    for number, order in enumerate(("-Y+X", "-Y-X", "+Y-X", "+Y+X", "+X-Y", "-X-Y", "-X+Y", "+X+Y"), 1)
}
_EXPONENT_BIAS = 128 + 8
_RUNS_BYTES = 60  # of a pixel while runs are decoded
_REPEAT = (1, 1, 1)  # a pixel that says how often the one before it is repeated


class RadianceHeader(NamedTuple):
    """The place where pixels begin, rows in the file and pixels in each, and their divisor [3]."""

    values_from: int
    size: tuple[int, int]
    scale: np.ndarray


def read_radiance_header(path: Path, spec: oiio.ImageSpec) -> RadianceHeader:
    """Parse the header of a Radiance file, and set the attributes that OpenImageIO has otherwise.

    Raises InputError for what is damaged in it.
    """
    with path.open("rb") as stream:
        start = stream.read(_LIMIT_BYTES)
    lines, _, rest = start.partition(b"\n\n")
    resolution = rest.partition(b"\n")[0]
    fields = defaultdict(list)
    for line in lines.decode("latin-1").split("\n"):
        name, _, text = line.partition("=")
        fields[name.strip()].append(text)
    try:
        exposures = [[float(text)] * 3 for text in fields["EXPOSURE"]]
        colours = [[float(word) for word in text.split()] for text in fields["COLORCORR"]]
        scale = np.prod(np.array([[1.0] * 3, *exposures, *colours]), 0).astype(np.float32)
        aspect = 1 / float(np.prod([float(text) for text in fields["PIXASPECT"]]))
        primaries = tuple(float(word) for text in fields["PRIMARIES"][-1:] for word in text.split())
        if not any(primaries):  # of the maps of Poly Haven, all 0
            primaries = ()
        slow, rows, fast, columns = resolution.decode("ascii").split()
        orientation, size = _ORIENTATIONS[slow + fast], (int(rows), int(columns))
        if not (np.isfinite(scale).all() and (scale > 0).all()) or len(primaries) not in (0, 8):
            raise ValueError("a number in it is out of range")
    except (ValueError, KeyError, ZeroDivisionError) as error:
        raise InputError(f"{path}: damaged: the header of a Radiance file is wrong ({error})") from None
    spec.attribute("Orientation", orientation)
    spec.attribute("PixelAspectRatio", aspect)
    if primaries:
        spec.attribute("chromaticities", oiio.TypeDesc("float[8]"), primaries)
    return RadianceHeader(len(lines) + len("\n\n") + len(resolution) + len("\n"), size, scale)


def require_rgb(path: Path) -> None:
    """Raise InputError for a Radiance file of CIE XYZ, which OpenImageIO does not read."""
    with path.open("rb") as stream:
        header = stream.read(_LIMIT_BYTES).partition(b"\n\n")[0]
    if header.startswith(b"#?") and b"FORMAT=32-bit_rle_xyze" in header:
        raise InputError(f"{path}: a Radiance file in XYZ is not read; convert it, as by ra_xyze -r")


def read_old_runs(path: Path, header: RadianceHeader) -> np.ndarray | None:
    """Decode values [H, W, 3] float32 of runs of pixels; None for the forms that OpenImageIO reads.

    These are pixels without runs, and runs by channel, of which each row begins with 2, 2 and its length.
    """
    height, width = header.size
    pixels = height * width
    with path.open("rb") as stream:
        stream.seek(header.values_from)
        stored = stream.read(4 * pixels)
    if len(stored) == 4 * pixels or stored[:4] == bytes([2, 2, width >> 8 & 255, width & 255]):
        return None
    memory.require(f"{path}: {width} x {height} pixels", _RUNS_BYTES * pixels, "make it smaller")
    records = np.frombuffer(stored[: len(stored) // 4 * 4], np.uint8).reshape(-1, 4)
    if not len(records):
        return None
    is_run = (records[:, :3] == _REPEAT).all(1)
    is_run[0] = False
    place = np.arange(len(records))
    pixel = np.maximum.accumulate(np.where(is_run, 0, place))  # whose record each run repeats
    shift = np.clip(8 * (place - pixel - 1), 0, 24)  # of runs in a row each counts 256 times as much
    count = np.where(is_run, np.minimum(records[:, 3].astype(np.int64) << shift, pixels), 1)
    if count.sum() < pixels:
        raise InputError(f"{path}: damaged or cut short: the Radiance file has too few pixels; copy it again")
    ends = int(np.searchsorted(np.cumsum(count), pixels)) + 1
    rgbe = np.repeat(records[pixel[:ends]], count[:ends], 0)[:pixels]
    values = np.ldexp(rgbe[:, :3].astype(np.float32), rgbe[:, 3:].astype(np.int32) - _EXPONENT_BIAS)
    return values.reshape(height, width, 3)
