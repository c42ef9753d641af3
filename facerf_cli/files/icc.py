"""ICC profiles (ICC.1:2022): parsing, profiles of linear spaces, and conversion by littleCMS.

Profiles of cameras, phones and displays contain three primaries and a curve each (matrix/TRC, 8.3.3), or a
grey curve; their colours are adapted to D50, so their space has that white. littleCMS, in 8 bits, applies
profiles of tables (printers, scanners) and CMYK. OpenColorIO would clamp floats and reject grey profiles.
"""

import io
import logging
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from facerf_cli.errors import InputError
from facerf_cli.files.workarounds import by_pillow
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

GREY = b"GRAY"  # in bytes 16 to 20 of a profile: the image's colour space
_KNOWN = (SRGB, DISPLAY_P3, ADOBE_RGB, REC2020, LINEAR, LINEAR_P3, LINEAR_REC2020, ACESCG, ACES)
_SAME_MATRIX, _SAME_CURVE = 2e-3, 5e-4  # rounding in profiles of the same space
_OUTSIDE = 0.1  # valid curves decode 0 to 1 within this distance of 0 to 1
_D50_XYZ = np.array([0.9642, 1.0, 0.8249])  # white of the connection space
_FIXED = 65536  # s15Fixed16Number
_MOST_TAGS, _MOST_ENTRIES = 200, 65536
_PARAMETERS = {0: 1, 1: 3, 2: 4, 3: 5, 4: 7}  # number of parameters per function type

log = logging.getLogger(LOGGER_NAME)


def space_of_profile(profile: bytes, name: str) -> ColourSpace | None:
    """Return the colour space of an RGB or grey profile; None if it is damaged or not matrix/TRC.

    A space that equals a known one within rounding is returned as the known one.
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
    for known in _KNOWN:  # matrices first: some curves need an import
        assert known.chromaticities is not None
        is_alike = np.allclose(matrix, matrix_to_rec709(known.chromaticities), 0, _SAME_MATRIX)
        if is_alike and np.allclose(ramp, _decoded_ramp(known), 0, _SAME_CURVE):
            return known
    return space


def _decoded_ramp(space: ColourSpace) -> np.ndarray:
    ramp = np.linspace(0, 1, 256, dtype=np.float32)[:, None].repeat(3, 1)
    return ramp if space.decode is None else space.decode(ramp)


def _parsed(profile: bytes, name: str) -> ColourSpace | None:
    """Parse a profile; damage raises any error of struct or numpy."""
    (count,), kind = struct.unpack_from(">I", profile, 128), profile[16:20]
    if profile[36:40] != b"acsp" or count > _MOST_TAGS:
        raise ValueError("not an ICC profile")
    entries = (struct.unpack_from(">4sII", profile, 132 + 12 * index) for index in range(count))
    tags = {signature: profile[offset : offset + size] for signature, offset, size in entries}
    if kind == GREY and b"kTRC" in tags:
        curve = _curve(tags[b"kTRC"])
        if profile[20:24] == b"Lab ":  # the connection space: the curve gives the lightness L*
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
    """Return the curve of [..., 3] that decodes each channel by its own; negative values are mirrored."""

    def decode(encoded: np.ndarray) -> np.ndarray:
        size = np.abs(encoded)
        decoded = [curve(size[..., index]) for index, curve in enumerate(curves)]
        return np.copysign(np.stack(decoded, -1), encoded).astype(np.float32)

    return decode


def _luminance_of(lightness: Curve) -> Curve:
    """Return the curve of luminance (CIE 15, white 1) for a curve of L* / 100."""

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
        if kind < 3:  # no linear segment: constant below d
            level = rest[2] if kind == 2 else 0.0
            return _parametric(g, a, b, 0.0, -b / a, level, level)
        return _parametric(g, *rest, *(0.0, 0.0)[: 6 - len(rest)])
    (count,) = struct.unpack_from(">I", tag, 8)
    if tag[:4] != b"curv" or count > _MOST_ENTRIES:
        raise ValueError("not a curve")
    if count <= 1:
        return _parametric(struct.unpack_from(">H", tag, 12)[0] / 256 if count else 1.0)
    entries = np.array(struct.unpack_from(f">{count}H", tag, 12)) / 65535
    samples, slope = np.linspace(0, 1, count), (entries[-1] - entries[-2]) * (count - 1)

    def sampled(encoded: np.ndarray) -> np.ndarray:  # linear between the entries and beyond the last
        beyond = entries[-1] + slope * (encoded - 1)
        return np.where(encoded > 1, beyond, np.interp(encoded, samples, entries))

    return sampled


def _parametric(
    g: float, a: float = 1, b: float = 0, c: float = 0, d: float = 0, e: float = 0, f: float = 0
) -> Curve:
    """Return the curve (a x + b)^g + e for x >= d, and c x + f below."""

    def curve(encoded: np.ndarray) -> np.ndarray:
        power = np.maximum(a * encoded + b, 0) ** g + e
        return np.where(encoded >= d, power, c * encoded + f)

    return curve


def has_tables(profile: bytes) -> bool:
    """Return whether a profile converts RGB only by tables."""
    tags = profile[132 : 132 + 12 * _MOST_TAGS]
    return profile[16:20] == b"RGB " and b"A2B" in tags and space_of_profile(profile, "") is None


def srgb_of_inks(path: Path, profile: bytes) -> np.ndarray:
    """Convert a CMYK JPEG or TIFF to sRGB [H, W, 3] uint8 by its profile, which OpenImageIO ignores.

    Raises InputError without a valid profile.
    """
    converted = by_pillow(path, lambda image: _by_littlecms(image, profile)) if profile else None
    if converted is None:
        raise InputError(
            f"{path}: CMYK without a valid profile, or with alpha, is not supported; convert it to RGB"
        )
    log.info("%s: CMYK, converted to sRGB by its profile", path)
    return np.asarray(converted)


def srgb_of_tables(path: Path, rgb: np.ndarray, profile: bytes, name: str) -> np.ndarray:
    """Convert colours [H, W, 3] uint8 to sRGB, uint8, by a profile of tables.

    Raises InputError for more bits, which littleCMS in Pillow would cut to 8.
    """
    if rgb.dtype != np.uint8 or rgb.shape[2] != 3:
        raise InputError(
            f"{path}: its profile '{name}' has tables, which are supported only for RGB of 8 bits; convert it"
            " to sRGB or Display P3"
        )
    from PIL import Image  # few files need it

    try:
        converted = _by_littlecms(Image.fromarray(np.ascontiguousarray(rgb)), profile)
    except Exception:  # any exception that damage causes in Pillow
        log.warning("%s: embedded profile '%s' is not supported; assuming sRGB", path, name)
        return rgb
    log.info("%s: converted to sRGB by its profile '%s'", path, name)
    return converted


def _by_littlecms(image: Any, profile: bytes) -> np.ndarray:
    """Convert a Pillow image to sRGB [H, W, 3] uint8 by its profile.

    As in Photoshop, colours are relative colorimetric with black point compensation.
    """
    from PIL import ImageCms

    source, target = ImageCms.getOpenProfile(io.BytesIO(profile)), ImageCms.createProfile("sRGB")
    intent, flags = ImageCms.Intent.RELATIVE_COLORIMETRIC, ImageCms.Flags.BLACKPOINTCOMPENSATION
    return np.asarray(ImageCms.profileToProfile(image, source, target, intent, "RGB", flags=flags))


def linear_profile(space: ColourSpace) -> bytes:
    """Return an ICC profile (version 2.4) of a linear space, for formats that cannot state it otherwise."""
    assert space.chromaticities is not None and space.decode is None
    matrix = rgb_to_xyz(space.chromaticities)
    colorants = adaptation(matrix.sum(1), _D50_XYZ) @ matrix
    text = space.name.encode("ascii") + b"\0"
    description = b"desc\0\0\0\0" + struct.pack(">I", len(text)) + text + bytes(4 + 4 + 2 + 1 + 67)
    line = b"curv\0\0\0\0" + bytes(4)  # no entries: the identity
    tags = {b"desc": description, b"cprt": b"text\0\0\0\0No copyright\0", b"wtpt": _xyz(_D50_XYZ)}
    for letter, column in zip((b"r", b"g", b"b"), colorants.T, strict=True):
        tags[letter + b"XYZ"], tags[letter + b"TRC"] = _xyz(column), line
    table, body, start = b"", b"", 132 + 12 * len(tags)
    for signature, content in tags.items():
        table += signature + struct.pack(">II", start + len(body), len(content))
        body += content + bytes(-len(content) % 4)
    header = bytearray(128)
    header[8:12], header[12:24], header[36:40] = b"\x02\x40\0\0", b"mntrRGB XYZ ", b"acsp"
    struct.pack_into(">6H", header, 24, 2026, 1, 1, 0, 0, 0)  # constant, so that files are reproducible
    header[68:80] = _xyz(_D50_XYZ)[8:]
    profile = bytes(header) + struct.pack(">I", len(tags)) + table + body
    return struct.pack(">I", len(profile)) + profile[4:]


def _xyz(values: np.ndarray) -> bytes:
    """Return an XYZType."""
    return b"XYZ \0\0\0\0" + struct.pack(">3i", *(round(float(value) * _FIXED) for value in values))
