"""What a picture's header says, without its pixels: its size, kind of numbers and colour space."""

import logging
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import OpenImageIO as oiio

from facerf_cli.colour import (
    ADOBE_RGB,
    DISPLAY_P3,
    LINEAR,
    REC2020,
    SRGB,
    ColourSpace,
    find_space,
    linear_space,
)
from facerf_cli.files.damage import utf8_path
from facerf_cli.records import LOGGER_NAME

_ICC_SPACES = {"display p3": DISPLAY_P3, "adobe rgb": ADOBE_RGB, "2020": REC2020, "srgb": SRGB}
log = logging.getLogger(LOGGER_NAME)


@dataclass(frozen=True)
class Header:
    """A picture's size upright, and what its values are."""

    width_px: int
    height_px: int
    is_floating: bool
    bits: int  # of a value
    space: ColourSpace  # what the file says; of one that says nothing what is usual: linear, or sRGB
    metadata: dict[str, Any]


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
    return Header(width, height, floating, bits, space_of_file(path, spec), metadata_of(spec))


def metadata_of(spec: oiio.ImageSpec) -> dict[str, Any]:
    """The plain attributes of a picture that is turned upright."""
    plain = (str, int, float, tuple)
    attributes = {entry.name: entry.value for entry in spec.extra_attribs if isinstance(entry.value, plain)}
    attributes.pop("Orientation", None)  # applied
    return attributes


def space_of_file(path: Path, spec: oiio.ImageSpec) -> ColourSpace:
    """What the file says of its colours; else floats are linear Rec.709 and integers sRGB."""
    default = LINEAR if is_floating(spec) else SRGB
    profile = spec.get_string_attribute("ICCProfile:profile_description")
    name = profile or spec.get_string_attribute("oiio:ColorSpace")
    if profile:
        named = next((space for part, space in _ICC_SPACES.items() if part in profile.lower()), None)
    elif name in ("", "Rec709"):  # the latter is OpenImageIO's word for every PNM file, whatever made it
        named = default
    else:
        named = find_space(name)
    if named is None:
        log.warning("%s: unknown colour space '%s', taken for %s", path, name, default.name)
        named = default
    chromaticities = spec.getattribute("chromaticities", oiio.TypeDesc("float[8]"))
    if not chromaticities or not named.is_linear:
        return named
    by_primaries = linear_space(chromaticities)
    if by_primaries is None:
        log.warning("%s: primaries of no colours that can be, taken for those of %s", path, named.name)
    return named if by_primaries in (None, LINEAR) else by_primaries


def is_floating(spec: oiio.ImageSpec) -> bool:
    """Whether values are of half, single or double precision."""
    return spec.format.basetype in (oiio.HALF, oiio.FLOAT, oiio.DOUBLE)
