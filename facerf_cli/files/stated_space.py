"""The colour space that an image file states: by codes (cICP), a profile, Exif, or numbers in its header.

In this order; of a PNG, gAMA and cHRM come last, as its specification says.
"""

import logging
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import OpenImageIO as oiio

from facerf_cli.errors import InputError
from facerf_cli.files.icc import GREY, space_of_profile
from facerf_cli.files.image_parts import is_floating, pick_channels
from facerf_cli.image.cicp import HDR_CURVES, space_of_codes
from facerf_cli.image.colour import (
    ADOBE_RGB,
    CINEON,
    DISPLAY_P3,
    LINEAR,
    REC709_CHROMATICITIES,
    REC2020,
    SRGB,
    ColourSpace,
    find_space,
    linear_space,
    power_curve,
)
from facerf_cli.run.logs import LOGGER_NAME, one_line

# Colour spaces by a part of the description, in lower case, of ICC profiles that hold tables; the first match
# counts.
_ICC_SPACES = {"display p3": DISPLAY_P3, "adobe rgb": ADOBE_RGB, "2020": REC2020, "srgb": SRGB}
OCIO_SPACE = "facerf:colourspace"  # the name of a space that only an OpenColorIO configuration defines
_SAYS_NOTHING = ("", "Rec709")  # OpenImageIO reports Rec709 for every PNM file, whatever wrote it
_JPEG_START, _PNG_START = b"\xff\xd8", b"\x89PNG"
_EXIF_SRGB, _EXIF_ADOBE = 1, 2  # ColorSpace; 2 is used, if not standard
_INTEROPERABILITY, _INDEX = 0xA005, 1  # of DCF: R98 is sRGB, R03 Adobe RGB

log = logging.getLogger(LOGGER_NAME)


def default_space(spec: oiio.ImageSpec) -> ColourSpace:
    """Return the colour space of a file that states none: linear Rec.709 for floats, sRGB for integers."""
    return LINEAR if is_floating(spec) else SRGB


def stated_space(path: Path, spec: oiio.ImageSpec) -> ColourSpace | None:
    """Return the colour space that the file states; None where it says nothing."""
    if is_ultra_hdr(path, spec):
        return _space_of_ultra_hdr(path, spec)
    default = default_space(spec)
    if codes := spec.getattribute("CICP"):
        return _space_of_codes(path, codes, default)
    description = spec.get_string_attribute("ICCProfile:profile_description")
    profile = spec.getattribute("ICCProfile")
    if profile is not None or description:
        profile = b"" if profile is None else bytes(profile)
        if profile[16:20] == GREY and len(pick_channels(spec)[0]) > 1:
            kind = f"embedded profile '{one_line(description)}' is for grey images"
            log.warning("%s: the %s; taken for %s", path, kind, default.name)
            return default
        return _space_of_icc(path, profile, description, default)
    if (found := _space_of_exif(path, spec) or _space_of_png(path)) is not None:
        return found
    name = spec.get_string_attribute("oiio:ColorSpace") or spec.get_string_attribute(OCIO_SPACE)
    chromaticities = spec.getattribute("chromaticities", oiio.TypeDesc("float[8]"))
    if name == "" and spec.get_string_attribute("dpx:Transfer") == "Printing density":
        return CINEON
    if name in _SAYS_NOTHING and not chromaticities:
        return None
    named = default if name in _SAYS_NOTHING else find_space(name)
    if named is None:
        log.warning("%s: unknown colour space '%s', taken for %s", path, name, default.name)
        named = default
    if not chromaticities or not named.is_linear:
        return named
    by_primaries = linear_space(chromaticities)
    if by_primaries is None:
        log.warning("%s: impossible primaries in the header; those of %s are used", path, named.name)
    return named if by_primaries in (None, LINEAR) else by_primaries


def _space_of_codes(path: Path, codes: tuple[int, ...], default: ColourSpace) -> ColourSpace:
    """Return the space of primaries, transfer function, matrix and range by ITU-T H.273."""
    primaries, transfer, _, full_range = codes
    if name := HDR_CURVES.get(transfer):
        raise InputError(f"{path}: is an HDR image ({name}); convert it to SDR, or to linear values as EXR")
    found = space_of_codes(primaries, transfer, bool(full_range))
    if found is None:
        log.warning(
            "%s: colour codes %d and %d are not understood; taken for %s", path, *codes[:2], default.name
        )
    return found or default


def _space_of_exif(path: Path, spec: oiio.ImageSpec) -> ColourSpace | None:
    """Return Adobe RGB for a camera's photo whose Exif says so; other photos are sRGB."""
    stated = spec.get_int_attribute("Exif:ColorSpace", _EXIF_SRGB)
    if stated == _EXIF_SRGB:
        return None
    index = by_pillow(path, lambda image: image.getexif().get_ifd(_INTEROPERABILITY).get(_INDEX))
    return ADOBE_RGB if stated == _EXIF_ADOBE or str(index).startswith("R03") else None


def _space_of_png(path: Path) -> ColourSpace | None:
    """Return the space of a PNG's gAMA and cHRM; None without them, and where it says sRGB."""
    with path.open("rb") as stream:
        is_png = stream.read(len(_PNG_START)) == _PNG_START
    info = (by_pillow(path, lambda image: dict(image.info)) if is_png else None) or {}
    if "srgb" in info or not {"gamma", "chromaticity"} & info.keys():
        return None
    white_first = info.get("chromaticity")
    primaries = (*white_first[2:], *white_first[:2]) if white_first else REC709_CHROMATICITIES
    gamma = info.get("gamma")
    linear = linear_space(primaries)
    if linear is None:
        log.warning("%s: impossible primaries in the header; sRGB is used", path)
    if linear is None or gamma == 1:
        return linear
    curve = power_curve(1 / gamma) if gamma else SRGB.decode
    return ColourSpace("PNG gAMA and cHRM", linear.chromaticities, curve)


def by_pillow(path: Path, read: Callable[[Any], Any]) -> Any:
    """Read what OpenImageIO leaves out of a header from the file as opened by Pillow; None if it cannot."""
    from PIL import Image  # few files need it

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # about large images, whose pixels are not decoded here
            with Image.open(path, formats=["JPEG", "PNG", "PSD", "TIFF", "WEBP"]) as image:
                return read(image)
    except Exception:  # whatever damage makes Pillow raise
        return None


def _space_of_icc(path: Path, profile: bytes, description: str, default: ColourSpace) -> ColourSpace:
    """Return the space of an embedded profile; of one that is not understood, by its name."""
    found = space_of_profile(profile, description)
    if found is None:
        lower = description.lower()
        found = next((space for part, space in _ICC_SPACES.items() if part in lower), None)
    if found is None:
        kind = f"embedded profile '{one_line(description)}' is not understood"
        log.warning("%s: the %s; taken for %s", path, kind, default.name)
    return found or default


def is_ultra_hdr(path: Path, spec: oiio.ImageSpec) -> bool:
    """Return whether a file is a JPEG with a gain map, which OpenImageIO applies: linear, with alpha of 1."""
    if not is_floating(spec):
        return False
    with path.open("rb") as stream:
        return stream.read(2) == _JPEG_START


def _space_of_ultra_hdr(path: Path, spec: oiio.ImageSpec) -> ColourSpace:
    """Return the linear space of a JPEG with a gain map, with the primaries of the map, else of the image.

    The gain map (ISO 21496-1) is the file's second image.
    """

    def of_second(image: Any) -> bytes:
        image.seek(1)
        return bytes(image.info.get("icc_profile", b""))

    stored = spec.getattribute("ICCProfile")
    profile = by_pillow(path, of_second) or (b"" if stored is None else bytes(stored))
    space = space_of_profile(profile, "") or SRGB
    return (space.chromaticities and linear_space(space.chromaticities)) or LINEAR
