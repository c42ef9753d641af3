"""What a picture's header says, without its pixels: its size, kind of numbers and colour space."""

from dataclasses import dataclass
from pathlib import Path

import OpenImageIO as oiio

from facerf_cli.colour import ColourSpace
from facerf_cli.files.damage import utf8_path
from facerf_cli.files.images import is_floating, space_of_file


@dataclass(frozen=True)
class Header:
    """A picture's size upright, and what its values are."""

    width_px: int
    height_px: int
    is_floating: bool
    bits: int  # of a value
    space: ColourSpace  # what the file says; of one that says nothing what is usual: linear, or sRGB


def read_header(path: Path) -> Header | None:
    """The header of a picture's first part; None where it is no picture that can be read."""
    stream = oiio.ImageInput.open(utf8_path(path)) if path.is_file() else None
    if stream is None:
        oiio.geterror()  # or it prints its own words at exit
        return None
    spec = stream.spec()
    stream.close()
    width, height = spec.full_width, spec.full_height
    if spec.get_int_attribute("Orientation", 1) >= 5:  # turned by a quarter
        width, height = height, width
    floating, bits = is_floating(spec), 8 * spec.format.size()
    return Header(width, height, floating, bits, space_of_file(path, spec))
