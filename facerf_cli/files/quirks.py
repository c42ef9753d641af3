"""Formats that OpenImageIO reads in part, or otherwise than they mean: PNG, TIFF, inks, PSD and Cineon.

The headers and the older runs of Radiance's files are in `radiance.py`; HEIC and AVIF in `isobmff.py`.
"""

import io
import struct
import warnings
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import OpenImageIO as oiio

from facerf_cli.errors import InputError

WHITE_IS_ZERO, SEPARATED, CIELAB = 0, 5, 8  # a TIFF's photometric interpretations
_RAW_COLOURS = (32803, 34892)  # of a colour filter array, of linear raw
ALPHA = ASSOCIATED, _UNASSOCIATED = 1, 2  # kinds of a TIFF's extra channels, by this tag:
_EXTRA_SAMPLES = 338
_THUMBNAIL = 1  # bit of a TIFF's NewSubfileType
_PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"
_CINEON_LITTLE = b"\xd7\x5f\x2a\x80"  # the first four bytes of a little-endian Cineon file
_PSD_VERSION, _HAS_COMPOSITE = 1057, 4  # a PSD's resource, and the place of a byte in it


def starts_with(path: Path, start: bytes, at: int = 0) -> bool:
    """Return whether a file has these bytes at its start, or at a place near it."""
    with path.open("rb") as stream:
        return stream.read(at + len(start))[at:] == start


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


def require_whole_png(path: Path) -> None:
    """Check the chunks and checksums of a PNG file to its end; a file of another kind passes.

    OpenImageIO does not report such damage reliably.
    """
    size = path.stat().st_size
    with path.open("rb") as stream:
        if stream.read(len(_PNG_SIGNATURE)) != _PNG_SIGNATURE:
            return
        kind = b""
        while kind != b"IEND":
            head = stream.read(8)
            length, kind = struct.unpack(">I4s", head) if len(head) == 8 else (0, b"")
            body, checksum = stream.read(min(length, size)), stream.read(4)  # a length may be 4 GiB
            if len(body) != length or len(checksum) != 4:
                raise InputError(f"{path}: damaged or cut short: the PNG file ends too early; copy it again")
            if zlib.crc32(kind + body) != int.from_bytes(checksum, "big"):
                raise InputError(f"{path}: damaged: a checksum of the PNG file is wrong; copy it again")


def require_whole_cineon(path: Path, spec: oiio.ImageSpec) -> None:
    """Raise InputError where 10-bit pixels are missing, three in 32 bits, which OpenImageIO leaves black."""
    with path.open("rb") as stream:
        magic, at = stream.read(4), stream.read(4)
    start = int.from_bytes(at, "little" if magic == _CINEON_LITTLE else "big")
    if path.stat().st_size < start + 4 * -(-spec.width * spec.height * spec.nchannels // 3):
        raise InputError(f"{path}: damaged or cut short; copy it again (pixels are missing)")


def require_composite(path: Path) -> None:
    """Raise InputError for a PSD that says that it has white in place of its layers."""
    resources = by_pillow(path, lambda image: {number: data for number, _, data in image.resources}) or {}
    if resources.get(_PSD_VERSION, b"")[_HAS_COMPOSITE:][:1] == b"\0":
        advice = "save it with Maximize Compatibility, or as PNG"
        raise InputError(f"{path}: a PSD without a composite of its layers is not read; {advice}")


def is_raw_tiff(path: Path, spec: oiio.ImageSpec, following: oiio.ImageSpec | None = None) -> bool:
    """Return whether a TIFF has a thumbnail first, before its next image, or the values of a sensor."""
    is_thumbnail = bool(spec.get_int_attribute("tiff:subfiletype", 0) & _THUMBNAIL)
    is_smaller = following is not None and 2 * spec.width <= following.width
    colours = spec.get_int_attribute("tiff:PhotometricInterpretation", -1)
    return starts_with(path, b"CR", 8) or is_thumbnail or is_smaller or colours in _RAW_COLOURS


def extra_channel(path: Path) -> int:
    """The kind of a TIFF's first channel after its colours, such as `ASSOCIATED` alpha; 0 says nothing."""
    from PIL.TiffImagePlugin import ImageFileDirectory_v2

    with path.open("rb") as stream:
        start = stream.read(16)
        directory = ImageFileDirectory_v2(start if 43 in start[2:4] else start[:8])  # 43: BigTIFF
        stream.seek(directory.next)
        directory.load(stream)
        return int(directory.get(_EXTRA_SAMPLES, (0,))[0])


def black_is_zero(values: np.ndarray, alpha: int | None) -> np.ndarray:
    """Undo white-is-zero [H, W, C]; OpenImageIO has done it to 8 bits, of alpha, too."""
    white = np.iinfo(values.dtype).max if values.dtype.kind == "u" else 1
    channels = [
        channel for channel in range(values.shape[-1]) if (channel == alpha) == (values.dtype == np.uint8)
    ]
    values[..., channels] = white - values[..., channels]
    return values


def rgb_of_inks(inks: np.ndarray, extra: int) -> np.ndarray:
    """Turn inks and an extra channel [H, W, 5 or more] into RGB and that, as OpenImageIO does without it."""
    alpha = inks[..., 4]
    if extra == ASSOCIATED:
        inks = inks / np.where(alpha > 0, alpha, 1)[..., None]
    return np.dstack([(1 - inks[..., :3]).clip(0, 1) * (1 - inks[..., 3:4]).clip(0, 1), alpha])


def by_profile_of_inks(path: Path, spec: oiio.ImageSpec) -> np.ndarray | None:
    """Convert a JPEG or TIFF of four inks to sRGB [H, W, 3] uint8 by its profile; None where it has none.

    OpenImageIO multiplies the inks, without the profile. As Photoshop does: relative colorimetric, with
    compensation of the black point.
    """
    profile = spec.getattribute("ICCProfile")
    stated = [spec.getattribute(f"{kind}:ColorSpace") for kind in ("jpeg", "tiff")]
    if profile is None or "CMYK" not in stated:
        return None
    from PIL import ImageCms  # few files need it

    def converted(image: Any) -> np.ndarray:
        source = ImageCms.getOpenProfile(io.BytesIO(bytes(profile)))
        intent, flags = ImageCms.Intent.RELATIVE_COLORIMETRIC, ImageCms.Flags.BLACKPOINTCOMPENSATION
        target = ImageCms.createProfile("sRGB")
        return np.asarray(ImageCms.profileToProfile(image, source, target, intent, "RGB", flags=flags))

    found: np.ndarray | None = by_pillow(path, converted)
    return found
