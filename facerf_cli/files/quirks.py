"""Formats that OpenImageIO reads in part, or otherwise than meant: PNG, TIFF, inks, PSD, Cineon, Radiance.

A header of Radiance's .hdr, lines `NAME=value`, ends with an empty line and the resolution, `-Y 512 +X 1024`.
EXPOSURE and COLORCORR, of which there may be several, have multiplied the values. HEIC and AVIF are in
`isobmff.py`.
"""

import io
import struct
import warnings
import zlib
from collections import defaultdict
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import OpenImageIO as oiio

from facerf_cli.errors import InputError
from facerf_cli.run import memory

WHITE_IS_ZERO, SEPARATED, CIELAB = 0, 5, 8  # a TIFF's photometric interpretations
_RAW_COLOURS = (32803, 34892)  # of a colour filter array, of linear raw
ALPHA = ASSOCIATED, _UNASSOCIATED = 1, 2  # kinds of a TIFF's extra channels, by this tag:
_EXTRA_SAMPLES = 338
_THUMBNAIL = 1  # bit of a TIFF's NewSubfileType
_PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"
_CINEON_LITTLE = b"\xd7\x5f\x2a\x80"  # the first four bytes of a little-endian Cineon file
_PSD_VERSION, _HAS_COMPOSITE = 1057, 4  # a PSD's resource, and the place of a byte in it
_LIMIT_BYTES = 1 << 16  # of a header
# The Exif orientation of each order of the axes: the first is that of rows in the file.
_ORIENTATIONS = {
    order: number
    for number, order in enumerate(("-Y+X", "-Y-X", "+Y-X", "+Y+X", "+X-Y", "-X-Y", "-X+Y", "+X+Y"), 1)
}
_EXPONENT_BIAS = 128 + 8
_RUNS_BYTES = 60  # of a pixel while runs are decoded
_REPEAT = (1, 1, 1)  # a pixel that says how often the one before it is repeated


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


def kinds_of_chunks(path: Path) -> set[bytes]:
    """The kinds of a PNG's chunks before its pixels; of a file of another kind none."""
    kinds: set[bytes] = set()
    with path.open("rb") as stream:
        if stream.read(len(_PNG_SIGNATURE)) == _PNG_SIGNATURE:
            while len(head := stream.read(8)) == 8 and head[4:] != b"IDAT":
                kinds.add(head[4:])
                stream.seek(int.from_bytes(head[:4], "big") + 4, 1)  # with a checksum
    return kinds


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


def require_rgb_radiance(path: Path) -> None:
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
