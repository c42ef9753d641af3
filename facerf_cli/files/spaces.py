"""The colour space that a file states: by codes (cICP), a profile (ICC), Exif, or numbers in its header.

They count in this order; gAMA and cHRM of a PNG come last, as its specification says. Profiles of cameras,
phones and displays are three primaries and a curve each (matrix/TRC; ICC.1:2022, 8.3.3), or a grey curve;
their colours are adapted to D50, so their space has that white. Profiles of tables, as printers have, are
known by their name alone.

Codes are those of ITU-T H.273. Films, and the images that ffmpeg takes from them, hold display values
whatever camera curve they state: codes of BT.709 and BT.601 are read by the sRGB curve, alike in both.
BT.2020 is read by its own curve.
"""

import logging
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import OpenImageIO as oiio

from facerf_cli.errors import InputError
from facerf_cli.files.quirks import by_pillow, kinds_of_chunks, starts_with
from facerf_cli.image.colour import (
    ACES,
    ACESCG,
    ADOBE_RGB,
    CINEON,
    DISPLAY_P3,
    LINEAR,
    LINEAR_P3,
    LINEAR_REC2020,
    REC709_CHROMATICITIES,
    REC2020,
    SRGB,
    ColourSpace,
    colour_science,
    find_space,
    known_space,
    linear_space,
    matrix_to_rec709,
    power_curve,
)
from facerf_cli.run.logs import LOGGER_NAME, one_line

Curve = Callable[[np.ndarray], np.ndarray]

# Colour spaces by a part of the description, in lower case, of ICC profiles that hold tables; the first match
# counts.
_ICC_SPACES = {"display p3": DISPLAY_P3, "adobe rgb": ADOBE_RGB, "2020": REC2020, "srgb": SRGB}
OCIO_SPACE = "facerf:colourspace"  # the name of a space that only an OpenColorIO configuration defines
_SAYS_NOTHING = ("", "Rec709")  # OpenImageIO reports Rec709 for every PNM file, whatever wrote it
_EXIF_SRGB, _EXIF_ADOBE = 1, 2  # ColorSpace; 2 is used, if not standard
_INTEROPERABILITY, _INDEX = 0xA005, 1  # of DCF: R98 is sRGB, R03 Adobe RGB

HDR_CURVES = {16: "PQ", 18: "HLG"}  # which are not read
_UNSPECIFIED = 2
_CURVES: dict[int, Curve | None] = {
    **dict.fromkeys((1, _UNSPECIFIED, 6, 13), SRGB.decode),
    4: power_curve(2.2),
    5: power_curve(2.8),
    8: None,  # linear
    **dict.fromkeys((14, 15), REC2020.decode),
}
_PRIMARIES = {  # that many files have, so that colour-science is not imported for them
    1: REC709_CHROMATICITIES,
    _UNSPECIFIED: REC709_CHROMATICITIES,
    9: REC2020.chromaticities,
    12: DISPLAY_P3.chromaticities,
}
_BLACK, _RANGE = 16 / 255, 219 / 255  # of the narrow range

_GREY = b"GRAY"  # of a profile's bytes 16 to 20: the colour space of the image
_KNOWN = (SRGB, DISPLAY_P3, ADOBE_RGB, REC2020, LINEAR, LINEAR_P3, LINEAR_REC2020, ACESCG, ACES)
_SAME_MATRIX, _SAME_CURVE = 2e-3, 5e-4  # rounding in profiles of the same space
_OUTSIDE = 0.1  # decoded values of a sound curve may leave 0..1 by this
_FIXED = 65536  # s15Fixed16Number
_MOST_TAGS, _MOST_ENTRIES = 200, 65536
_PARAMETERS = {0: 1, 1: 3, 2: 4, 3: 5, 4: 7}  # how many each function type has

log = logging.getLogger(LOGGER_NAME)


def is_floating(spec: oiio.ImageSpec) -> bool:
    """Return whether values are half, single or double precision floats."""
    return spec.format.basetype in (oiio.HALF, oiio.FLOAT, oiio.DOUBLE)


def default_space(spec: oiio.ImageSpec) -> ColourSpace:
    """Return the colour space of a file that states none: linear Rec.709 for floats, sRGB for integers."""
    return LINEAR if is_floating(spec) else SRGB


def is_ultra_hdr(path: Path, spec: oiio.ImageSpec) -> bool:
    """Return whether a file is a JPEG with a gain map, which OpenImageIO applies: linear, with alpha of 1."""
    return is_floating(spec) and starts_with(path, b"\xff\xd8")


def stated_space(path: Path, spec: oiio.ImageSpec) -> ColourSpace | None:
    """Return the colour space that the file states; None where it says nothing."""
    default = default_space(spec)
    stored = spec.getattribute("ICCProfile")
    profile = b"" if stored is None else bytes(stored)
    if is_ultra_hdr(path, spec):
        return _space_of_ultra_hdr(path, profile)
    if codes := spec.getattribute("CICP"):
        primaries, transfer, _, full_range = codes
        if name := HDR_CURVES.get(transfer):
            raise InputError(
                f"{path}: is an HDR image ({name}); convert it to SDR, or to linear values as EXR"
            )
        found = space_of_codes(primaries, transfer, bool(full_range))
        if found is None:
            kind = f"colour codes {primaries} and {transfer} are not understood"
            log.warning("%s: %s; taken for %s", path, kind, default.name)
        return found or default
    description = spec.get_string_attribute("ICCProfile:profile_description")
    if stored is not None or description:
        colours = spec.nchannels - (spec.alpha_channel >= 0)
        if profile[16:20] == _GREY and colours >= 3:
            found, kind = None, "is for grey images"
        else:
            named = (space for part, space in _ICC_SPACES.items() if part in description.lower())
            found, kind = space_of_profile(profile, description) or next(named, None), "is not understood"
        if found is None:
            kind = f"embedded profile '{one_line(description)}' {kind}"
            log.warning("%s: the %s; taken for %s", path, kind, default.name)
        return found or default
    return _space_of_exif(path, spec) or _space_of_png(path) or _space_of_header(path, spec, default)


def _space_of_ultra_hdr(path: Path, profile: bytes) -> ColourSpace:
    """Return the linear space of a JPEG with a gain map, with the primaries of the map, else of the image.

    The gain map (ISO 21496-1) is the file's second image.
    """

    def of_second(image: Any) -> bytes:
        image.seek(1)
        return bytes(image.info.get("icc_profile", b""))

    space = space_of_profile(by_pillow(path, of_second) or profile, "") or SRGB
    return (space.chromaticities and linear_space(space.chromaticities)) or LINEAR


def _space_of_exif(path: Path, spec: oiio.ImageSpec) -> ColourSpace | None:
    """Return Adobe RGB for a camera's photo whose Exif says so; other photos are sRGB."""
    stated = spec.get_int_attribute("Exif:ColorSpace", _EXIF_SRGB)
    if stated == _EXIF_SRGB:
        return None
    index = by_pillow(path, lambda image: image.getexif().get_ifd(_INTEROPERABILITY).get(_INDEX))
    return ADOBE_RGB if stated == _EXIF_ADOBE or str(index).startswith("R03") else None


def _space_of_png(path: Path) -> ColourSpace | None:
    """Return the space of a PNG's gAMA and cHRM; None without them, and where it says sRGB."""
    kinds = kinds_of_chunks(path)
    is_told = b"sRGB" not in kinds and not kinds.isdisjoint((b"gAMA", b"cHRM"))
    info = by_pillow(path, lambda image: dict(image.info)) if is_told else None
    if not info:
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


def _space_of_header(path: Path, spec: oiio.ImageSpec, default: ColourSpace) -> ColourSpace | None:
    """Return the space by the name and the chromaticities that OpenImageIO reports."""
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


def space_of_codes(primaries: int, transfer: int, full_range: bool = True) -> ColourSpace | None:
    """Return the colour space of two code points, with its usual name if it has one; None if unknown."""
    chromaticities = _PRIMARIES.get(primaries)
    if chromaticities is None:
        codes = colour_science().models.rgb.itut_h_273
        try:
            points = *codes.COLOUR_PRIMARIES_ITUTH273[primaries], codes.CCS_WHITEPOINTS_ITUTH273[primaries]
            chromaticities = tuple(round(float(value), 4) for value in np.vstack(points).ravel())
        except (KeyError, TypeError, ValueError):  # reserved
            return None
    if transfer not in _CURVES:
        return None
    decode, name = _CURVES[transfer], f"CICP {primaries}-{transfer}"
    if full_range:
        return known_space(ColourSpace(name, chromaticities, decode))
    curve = decode or (lambda values: values)
    return ColourSpace(
        f"{name}, narrow range", chromaticities, lambda encoded: curve((encoded - _BLACK) / _RANGE)
    )


def space_of_profile(profile: bytes, name: str) -> ColourSpace | None:
    """Return the colour space of an RGB or grey profile; None if it is broken, or is not matrix/TRC.

    A space that differs from a known one by rounding only is that one.
    """
    try:
        space = _parsed(profile, name or "ICC profile")
    except (ValueError, struct.error, ZeroDivisionError, np.linalg.LinAlgError):
        return None
    if space is None or space.chromaticities is None:
        return None
    with np.errstate(all="ignore"):
        ramp = _decoded_ramp(space)
    if not (np.abs(ramp - 0.5) < 0.5 + _OUTSIDE).all() or linear_space(space.chromaticities) is None:
        return None
    matrix = matrix_to_rec709(space.chromaticities)
    for known in _KNOWN:  # matrices first, before a curve that has to be imported
        assert known.chromaticities is not None
        is_alike = np.allclose(matrix, matrix_to_rec709(known.chromaticities), 0, _SAME_MATRIX)
        if is_alike and np.allclose(ramp, _decoded_ramp(known), 0, _SAME_CURVE):
            return known
    return space


def _decoded_ramp(space: ColourSpace) -> np.ndarray:
    ramp = np.linspace(0, 1, 256, dtype=np.float32)[:, None].repeat(3, 1)
    return ramp if space.decode is None else space.decode(ramp)


def _parsed(profile: bytes, name: str) -> ColourSpace | None:
    """Read the tags of a profile; whatever struct or numpy raises where it is broken."""
    (count,), kind = struct.unpack_from(">I", profile, 128), profile[16:20]
    if profile[36:40] != b"acsp" or count > _MOST_TAGS:
        raise ValueError("not an ICC profile")
    entries = (struct.unpack_from(">4sII", profile, 132 + 12 * index) for index in range(count))
    tags = {signature: profile[offset : offset + size] for signature, offset, size in entries}
    if kind == _GREY and b"kTRC" in tags:
        curve = _curve(tags[b"kTRC"])
        if profile[20:24] == b"Lab ":  # the connection space, in which the curve gives the lightness L*
            curve = _luminance_of(curve)
        return ColourSpace(name, REC709_CHROMATICITIES, _by_channel(curve, curve, curve))
    wanted = [letter + part for part in (b"XYZ", b"TRC") for letter in (b"r", b"g", b"b")]
    if kind != b"RGB " or not all(tag in tags for tag in wanted):
        return None
    colorants = np.array([struct.unpack_from(">3i", tags[tag], 8) for tag in wanted[:3]]) / _FIXED
    sums = colorants.sum(1, keepdims=True)
    white = colorants.sum(0)
    if (sums <= 0).any() or (white <= 0).any():
        return None
    xy = np.vstack([colorants / sums, white / white.sum()])[:, :2]
    return ColourSpace(name, tuple(xy.ravel()), _by_channel(*(_curve(tags[tag]) for tag in wanted[3:])))


def _by_channel(*curves: Curve) -> Curve:
    """Decode each channel of [..., 3] by its curve; negative values are mirrored."""

    def decode(encoded: np.ndarray) -> np.ndarray:
        size = np.abs(encoded)
        decoded = [curve(size[..., index]) for index, curve in enumerate(curves)]
        return np.copysign(np.stack(decoded, -1), encoded).astype(np.float32)

    return decode


def _luminance_of(lightness: Curve) -> Curve:
    """Luminance of white 1 of a curve of L* / 100 (CIE 15)."""

    def curve(encoded: np.ndarray) -> np.ndarray:
        value = 100 * lightness(encoded)
        return np.where(value > 8, ((value + 16) / 116) ** 3, value * 27 / 24389)

    return curve


def _curve(tag: bytes) -> Curve:
    """Parse a curveType or a parametricCurveType (names g a b c d e f of the ICC specification, table 68)."""
    if tag[:4] == b"para":
        (kind,) = struct.unpack_from(">H", tag, 8)
        if kind not in _PARAMETERS:
            raise ValueError(f"function type {kind}")
        g, *rest = (value / _FIXED for value in struct.unpack_from(f">{_PARAMETERS[kind]}i", tag, 12))
        a, b = rest[:2] or (1.0, 0.0)
        if kind < 3:  # without a line: below d it is constant
            level = rest[2] if kind == 2 else 0.0
            return _parametric(g, a, b, 0.0, -b / a, level, level)
        return _parametric(g, *rest, *(0.0, 0.0)[: 6 - len(rest)])
    (count,) = struct.unpack_from(">I", tag, 8)
    if tag[:4] != b"curv" or count > _MOST_ENTRIES:
        raise ValueError("not a curve")
    if count <= 1:
        return _parametric(struct.unpack_from(">H", tag, 12)[0] / 256 if count else 1.0)
    entries = np.array(struct.unpack_from(f">{count}H", tag, 12)) / 65535
    places, slope = np.linspace(0, 1, count), (entries[-1] - entries[-2]) * (count - 1)

    def sampled(encoded: np.ndarray) -> np.ndarray:  # linear between its entries and beyond the last
        beyond = entries[-1] + slope * (encoded - 1)
        return np.where(encoded > 1, beyond, np.interp(encoded, places, entries))

    return sampled


def _parametric(
    g: float, a: float = 1, b: float = 0, c: float = 0, d: float = 0, e: float = 0, f: float = 0
) -> Curve:
    """(a x + b)^g + e from x = d on, and c x + f below."""

    def curve(encoded: np.ndarray) -> np.ndarray:
        power = np.maximum(a * encoded + b, 0) ** g + e
        return np.where(encoded >= d, power, c * encoded + f)

    return curve
