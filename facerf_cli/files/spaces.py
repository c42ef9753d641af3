"""Colour space that an image file states.

In order of precedence: codes (cICP), an ICC profile, Exif, numbers in the header (gAMA and cHRM of a PNG).
Codes are those of ITU-T H.273. Videos, and images that ffmpeg extracts from them, contain display values
whatever camera curve they state: BT.709 and BT.601 are therefore decoded by the sRGB curve, BT.2020 by its
own.
"""

import logging
import struct
from itertools import takewhile
from pathlib import Path
from typing import Any

import OpenImageIO as oiio

from facerf_cli.errors import InputError
from facerf_cli.files.icc import GREY, Curve, has_tables, space_of_profile
from facerf_cli.files.workarounds import by_pillow, png_chunks, starts_with
from facerf_cli.image.colour import (
    ADOBE_RGB,
    DISPLAY_P3,
    LINEAR,
    REC709_CHROMATICITIES,
    REC2020,
    SRGB,
    ColourSpace,
    find_space,
    known_space,
    linear_space,
    power_curve,
)
from facerf_cli.run.logs import LOGGER_NAME, one_line

OCIO_SPACE = "facerf:colourspace"  # name of a space that only an OpenColorIO configuration defines
_UNSTATED = ("", "Rec709")  # OpenImageIO reports Rec709 for every PNM file
_EXIF_SRGB, _EXIF_ADOBE = 1, 2  # ColorSpace; 2 is common but not in the standard
_INTEROPERABILITY, _INDEX = 0xA005, 1  # DCF: R98 is sRGB, R03 Adobe RGB

HDR_CURVES = {16: "PQ", 18: "HLG"}  # not supported
_UNSPECIFIED = 2
_CURVES: dict[int, Curve | None] = {
    **dict.fromkeys((1, _UNSPECIFIED, 6, 13), SRGB.decode),
    4: power_curve(2.2),
    5: power_curve(2.8),
    8: None,  # linear
    **dict.fromkeys((14, 15), REC2020.decode),
}
_NTSC = (0.63, 0.34, 0.31, 0.595, 0.155, 0.07, 0.3127, 0.3290)
_PRIMARIES = {
    1: REC709_CHROMATICITIES,
    _UNSPECIFIED: REC709_CHROMATICITIES,
    5: (0.64, 0.33, 0.29, 0.60, 0.15, 0.06, 0.3127, 0.3290),  # PAL
    6: _NTSC,
    7: _NTSC,
    9: REC2020.chromaticities,
    11: (0.68, 0.32, 0.265, 0.69, 0.15, 0.06, 0.314, 0.351),  # DCI-P3
    12: DISPLAY_P3.chromaticities,
}

log = logging.getLogger(LOGGER_NAME)


def is_floating(spec: oiio.ImageSpec) -> bool:
    """Return whether values are half, single or double precision floats."""
    return spec.format.basetype in (oiio.HALF, oiio.FLOAT, oiio.DOUBLE)


def default_space(spec: oiio.ImageSpec) -> ColourSpace:
    """Return the space assumed for a file that states none: linear Rec.709 for floats, sRGB for integers."""
    return LINEAR if is_floating(spec) else SRGB


def is_ultra_hdr(path: Path, spec: oiio.ImageSpec) -> bool:
    """Return whether a file is a JPEG with a gain map; OpenImageIO applies it (linear, alpha 1)."""
    return is_floating(spec) and starts_with(path, b"\xff\xd8")


def profile_of(spec: oiio.ImageSpec) -> bytes:
    """Return the embedded ICC profile; empty without one."""
    stored = spec.getattribute("ICCProfile")
    return b"" if stored is None else bytes(stored)


def profile_of_tables(path: Path, spec: oiio.ImageSpec) -> bytes:
    """Return the ICC profile if it applies and converts by tables, which needs littleCMS; else nothing."""
    profile = profile_of(spec)
    applies = has_tables(profile) and not spec.getattribute("CICP") and not is_ultra_hdr(path, spec)
    return profile if applies else b""


def stated_space(path: Path, spec: oiio.ImageSpec) -> ColourSpace | None:
    """Return the colour space that the file states; None without a statement, and for profiles of tables.

    Raises InputError for HDR images and narrow range.
    """
    default, profile = default_space(spec), profile_of(spec)
    if is_ultra_hdr(path, spec):
        return _space_of_ultra_hdr(path, profile)
    if codes := spec.getattribute("CICP"):
        primaries, transfer, _, full_range = codes
        if name := HDR_CURVES.get(transfer):
            raise InputError(f"{path}: HDR ({name}) is not supported; convert it to SDR, or to linear EXR")
        if not full_range:
            raise InputError(f"{path}: narrow-range values are not supported; convert it to full range")
        space = space_of_codes(primaries, transfer)
        if space is None:
            log.warning(
                "%s: unknown colour codes %d and %d; assuming %s", path, primaries, transfer, default.name
            )
        return space or default
    if profile_of_tables(path, spec):
        return None
    if profile:
        description = spec.get_string_attribute("ICCProfile:profile_description")
        is_for_grey = profile[16:20] == GREY and spec.nchannels - (spec.alpha_channel >= 0) >= 3
        space = None if is_for_grey else space_of_profile(profile, description)
        if space is None:
            cause = "is for grey images" if is_for_grey else "is not supported"
            log.warning(
                "%s: embedded profile '%s' %s; assuming %s", path, one_line(description), cause, default.name
            )
        return space or default
    return _space_of_exif(path, spec) or _space_of_png(path) or _space_of_header(path, spec, default)


def _space_of_ultra_hdr(path: Path, profile: bytes) -> ColourSpace:
    """Return the linear space with the primaries of the gain map (ISO 21496-1), else of the base image.

    The gain map is the file's second image.
    """

    def of_second(image: Any) -> bytes:
        image.seek(1)
        return bytes(image.info.get("icc_profile", b""))

    space = space_of_profile(by_pillow(path, of_second) or profile, "") or SRGB
    return (space.chromaticities and linear_space(space.chromaticities)) or LINEAR


def _space_of_exif(path: Path, spec: oiio.ImageSpec) -> ColourSpace | None:
    """Return Adobe RGB if Exif states it."""
    stated = spec.get_int_attribute("Exif:ColorSpace", _EXIF_SRGB)
    if stated == _EXIF_SRGB:
        return None
    index = by_pillow(path, lambda image: image.getexif().get_ifd(_INTEROPERABILITY).get(_INDEX))
    return ADOBE_RGB if stated == _EXIF_ADOBE or str(index).startswith("R03") else None


def _space_of_png(path: Path) -> ColourSpace | None:
    """Return the space of a PNG's gAMA and cHRM; None without them, and if an sRGB chunk overrides them."""
    chunks = dict(takewhile(lambda chunk: chunk[0] != b"IDAT", png_chunks(path)))
    if b"sRGB" in chunks or chunks.keys().isdisjoint((b"gAMA", b"cHRM")):
        return None
    primaries, gamma = REC709_CHROMATICITIES, 0.0
    try:
        if stored := chunks.get(b"cHRM"):
            white_first = [value / 100000 for value in struct.unpack(">8I", stored)]
            primaries = (*white_first[2:], *white_first[:2])
        if stored := chunks.get(b"gAMA"):
            gamma = struct.unpack(">I", stored)[0] / 100000
    except struct.error:
        return None
    linear = linear_space(primaries)
    if linear is None:
        log.warning("%s: impossible primaries in the header; assuming sRGB", path)
    if linear is None or gamma == 1:
        return linear
    curve = power_curve(1 / gamma) if gamma else SRGB.decode
    return ColourSpace("PNG gAMA and cHRM", linear.chromaticities, curve)


def _space_of_header(path: Path, spec: oiio.ImageSpec, default: ColourSpace) -> ColourSpace | None:
    """Return the space from the name and the chromaticities that OpenImageIO reports."""
    name = spec.get_string_attribute("oiio:ColorSpace") or spec.get_string_attribute(OCIO_SPACE)
    chromaticities = spec.getattribute("chromaticities", oiio.TypeDesc("float[8]"))
    if name in _UNSTATED and not chromaticities:
        return None
    named = default if name in _UNSTATED else find_space(name)
    if named is None:
        log.warning("%s: unknown colour space '%s'; assuming %s", path, name, default.name)
        named = default
    if not chromaticities or not named.is_linear:
        return named
    by_primaries = linear_space(chromaticities)
    if by_primaries is None:
        log.warning("%s: impossible primaries in the header; assuming the primaries of %s", path, named.name)
    return named if by_primaries in (None, LINEAR) else by_primaries


def space_of_codes(primaries: int, transfer: int) -> ColourSpace | None:
    """Return the colour space of two code points, by its usual name if it has one; None if unknown."""
    chromaticities = _PRIMARIES.get(primaries)
    if chromaticities is None or transfer not in _CURVES:
        return None
    return known_space(ColourSpace(f"CICP {primaries}-{transfer}", chromaticities, _CURVES[transfer]))
