"""ICC profiles (ICC.1:2022): the spaces of profiles that are read, the profiles of linear ones, littleCMS.

Profiles of cameras, phones and displays are three primaries and a curve each (matrix/TRC, 8.3.3), or a grey
curve; their colours are adapted to D50, so their space has that white. Profiles of tables, as printers and
scanners have, and those of inks are applied by littleCMS, in 8 bits.
"""

import io
import logging
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from facerf_cli.errors import InputError
from facerf_cli.files.quirks import by_pillow
from facerf_cli.image.colour import (
    ACES,
    ACESCG,
    ADOBE_RGB,
    DISPLAY_P3,
    LINEAR,
    LINEAR_P3,
    LINEAR_REC2020,
    REC709_CHROMATICITIES,
    REC2020,
    SRGB,
    ColourSpace,
    adaptation,
    linear_space,
    matrix_to_rec709,
    rgb_to_xyz,
)
from facerf_cli.run.logs import LOGGER_NAME

Curve = Callable[[np.ndarray], np.ndarray]

GREY = b"GRAY"  # of a profile's bytes 16 to 20: the colour space of the image
_KNOWN = (SRGB, DISPLAY_P3, ADOBE_RGB, REC2020, LINEAR, LINEAR_P3, LINEAR_REC2020, ACESCG, ACES)
_SAME_MATRIX, _SAME_CURVE = 2e-3, 5e-4  # rounding in profiles of the same space
_OUTSIDE = 0.1  # decoded values of a sound curve may leave 0..1 by this
_D50_XYZ = np.array([0.9642, 1.0, 0.8249])  # of the connection space
_FIXED = 65536  # s15Fixed16Number
_MOST_TAGS, _MOST_ENTRIES = 200, 65536
_PARAMETERS = {0: 1, 1: 3, 2: 4, 3: 5, 4: 7}  # how many each function type has

log = logging.getLogger(LOGGER_NAME)


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
    if kind == GREY and b"kTRC" in tags:
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


def has_tables(profile: bytes) -> bool:
    """Return whether a profile converts RGB by tables alone."""
    tags = profile[132 : 132 + 12 * _MOST_TAGS]
    return profile[16:20] == b"RGB " and b"A2B" in tags and space_of_profile(profile, "") is None


def srgb_of_inks(path: Path, profile: bytes) -> np.ndarray:
    """Convert a JPEG or TIFF of inks to sRGB [H, W, 3] uint8 by its profile.

    OpenImageIO multiplies the inks, without the profile. Raises InputError without a profile that is sound.
    """
    found = by_pillow(path, lambda image: _by_littlecms(image, profile)) if profile else None
    if found is None:
        kind = "inks (CMYK) without a profile, or with alpha, are not read"
        raise InputError(f"{path}: {kind}; convert the image to RGB")
    log.info("%s: inks, converted to sRGB by their profile", path)
    return np.asarray(found)


def srgb_of_tables(path: Path, rgb: np.ndarray, profile: bytes, name: str) -> np.ndarray:
    """Convert colours [H, W, 3] uint8 to sRGB, uint8, by a profile of tables.

    Raises InputError for more bits, which littleCMS in Pillow would cut to 8.
    """
    if rgb.dtype != np.uint8 or rgb.shape[2] != 3:
        kind = f"its profile '{name}' has tables, which are applied to RGB of 8 bits only"
        raise InputError(f"{path}: {kind}; convert the image to sRGB or Display P3")
    from PIL import Image  # few files need it

    try:
        found = _by_littlecms(Image.fromarray(np.ascontiguousarray(rgb)), profile)
    except Exception:  # whatever damage makes Pillow raise
        log.warning("%s: the embedded profile '%s' is not understood; taken for sRGB", path, name)
        return rgb
    log.info("%s: converted to sRGB by its profile '%s'", path, name)
    return found


def _by_littlecms(image: Any, profile: bytes) -> np.ndarray:
    """Convert an image of Pillow to sRGB [H, W, 3] uint8 by its profile.

    As Photoshop does: relative colorimetric, with compensation of the black point.
    """
    from PIL import ImageCms

    source, target = ImageCms.getOpenProfile(io.BytesIO(profile)), ImageCms.createProfile("sRGB")
    intent, flags = ImageCms.Intent.RELATIVE_COLORIMETRIC, ImageCms.Flags.BLACKPOINTCOMPENSATION
    return np.asarray(ImageCms.profileToProfile(image, source, target, intent, "RGB", flags=flags))


def linear_profile(space: ColourSpace) -> bytes:
    """Return an ICC profile (version 2.4) of a linear space, for files that have no other way to state it."""
    assert space.chromaticities is not None and space.decode is None
    matrix = rgb_to_xyz(space.chromaticities)
    colorants = adaptation(matrix.sum(1), _D50_XYZ) @ matrix
    text = space.name.encode("ascii") + b"\0"
    description = b"desc\0\0\0\0" + struct.pack(">I", len(text)) + text + bytes(4 + 4 + 2 + 1 + 67)
    line = b"curv\0\0\0\0" + bytes(4)  # without entries: the identity
    tags = {b"desc": description, b"cprt": b"text\0\0\0\0No copyright\0", b"wtpt": _xyz(_D50_XYZ)}
    for letter, column in zip((b"r", b"g", b"b"), colorants.T, strict=True):
        tags[letter + b"XYZ"], tags[letter + b"TRC"] = _xyz(column), line
    table, body, start = b"", b"", 132 + 12 * len(tags)
    for signature, content in tags.items():
        table += signature + struct.pack(">II", start + len(body), len(content))
        body += content + bytes(-len(content) % 4)
    header = bytearray(128)
    header[8:12], header[12:24], header[36:40] = b"\x02\x40\0\0", b"mntrRGB XYZ ", b"acsp"
    struct.pack_into(">6H", header, 24, 2026, 1, 1, 0, 0, 0)  # fixed, so that files are reproducible
    header[68:80] = _xyz(_D50_XYZ)[8:]
    whole = bytes(header) + struct.pack(">I", len(tags)) + table + body
    return struct.pack(">I", len(whole)) + whole[4:]


def _xyz(values: np.ndarray) -> bytes:
    """Return an XYZType."""
    return b"XYZ \0\0\0\0" + struct.pack(">3i", *(round(float(value) * _FIXED) for value in values))
