"""Gaps of OpenImageIO: refusal of rare formats, detection of damage, alpha, parts of headers."""

import logging
import math
import re
import struct
import warnings
import zlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import OpenImageIO as oiio

from facerf_cli.errors import InputError
from facerf_cli.image.colour import unit_floats
from facerf_cli.run.logs import LOGGER_NAME, one_line

_RAW = (
    ".3fr .arw .cr2 .cr3 .crw .dcr .dng .erf .fff .iiq .kdc .mef .mos .mrw .nef .nrw .orf .pef .raf .raw .rw2"
    " .rwl .sr2 .srf .srw .x3f"
)
RAW_SUFFIXES = frozenset(_RAW.split())
UNDEVELOPED = (  # OpenImageIO would read the thumbnail
    "camera raw, or an image that starts with a thumbnail, is not supported; develop it to EXR, TIFF or JPEG,"
    " for example in darktable"
)
# Formats whose colour is multiplied by alpha, unless the header states otherwise.
_ASSOCIATED = ("openexr", "tiff", "targa", "rla", "iff", "dpx", "softimage", "heif", "avif")
_EXTRA_SAMPLES, _ASSOCIATED_ALPHA = 338, 1  # tag of a TIFF, and one of its values
_TGA_ALPHA = 4
# Photometric interpretations of a TIFF.
_WHITE_IS_ZERO, _SEPARATED, _CIELAB, _RAW_COLOURS = 0, 5, 8, (32803, 34892)
_THUMBNAIL = 1  # bit of a TIFF's NewSubfileType
_FILM_CURVES = ("Logarithmic", "Printing density")  # in a DPX header
_PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"
_PSD_VERSION, _HAS_COMPOSITE = 1057, 4  # a PSD's resource, and the offset of a byte in it
_HEADER_BYTES = 1 << 16  # of a Radiance file
_NOISE, _MOST_ABOVE = 0.01, 0.02  # premultiplied colour may exceed alpha by this, in this fraction of pixels
_UNSUPPORTED = re.compile(
    r"unsupported|not (supported|configured|implemented|available)|unknown compression", re.I
)

log = logging.getLogger(LOGGER_NAME)


def refuse_rare(path: Path, form: str, spec: oiio.ImageSpec, following: oiio.ImageSpec | None) -> None:
    """Raise InputError for rare kinds of files; the error names the conversion.

    `form` is OpenImageIO's format name, `spec` the header of the image to read, and `following` the header
    of a TIFF's second page.
    """
    meaning = spec.get_int_attribute("tiff:PhotometricInterpretation", -1)
    is_thumbnail = spec.get_int_attribute("tiff:subfiletype", 0) & _THUMBNAIL
    is_smaller = following is not None and 2 * spec.width <= following.width
    is_raw = meaning in _RAW_COLOURS or is_thumbnail or is_smaller or starts_with(path, b"CR", offset=8)
    is_log = form == "cineon" or spec.get_string_attribute("dpx:Transfer") in _FILM_CURVES
    is_turned = form == "dpx" and spec.get_int_attribute("Orientation", 1) >= 5
    resources: dict[int, bytes] = {}
    if form == "psd":
        resources = by_pillow(path, lambda image: {number: data for number, _, data in image.resources}) or {}
    for is_rare, message in (
        (spec.deep, "deep data is not supported; flatten it with oiiotool --flatten"),
        (form == "tiff" and is_raw, UNDEVELOPED),
        (meaning == _WHITE_IS_ZERO, "TIFF with white as zero is not supported; save it as PNG"),
        (meaning == _CIELAB, "TIFF in CIELAB is not supported; convert it to RGB"),
        (
            resources.get(_PSD_VERSION, b"")[_HAS_COMPOSITE:][:1] == b"\0",
            "PSD without a composite is not supported; save it with Maximize Compatibility, or as PNG",
        ),
        (is_log, "Cineon log film scans are not supported; convert it to linear values, as EXR"),
        (is_turned, "DPX with rotated pixels is not supported; save it upright"),
    ):
        if is_rare:
            raise InputError(f"{path}: {message}")


def has_inks(spec: oiio.ImageSpec) -> bool:
    """Return whether a JPEG or TIFF is CMYK."""
    is_separated = spec.get_int_attribute("tiff:PhotometricInterpretation", -1) == _SEPARATED
    return is_separated or spec.get_string_attribute("jpeg:ColorSpace") in ("CMYK", "YCbCrK")


def starts_with(path: Path, start: bytes, offset: int = 0) -> bool:
    """Return whether a file has these bytes at an offset near its start."""
    with path.open("rb") as stream:
        return stream.read(offset + len(start))[offset:] == start


def by_pillow(path: Path, read: Callable[[Any], Any]) -> Any:
    """Return `read(image)` for the file opened by Pillow; None if that fails."""
    from PIL import Image  # few files need it

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # about large images, whose pixels are not decoded here
            with Image.open(path, formats=["JPEG", "PNG", "PSD", "TIFF", "WEBP"]) as image:
                return read(image)
    except Exception:  # any exception that damage causes in Pillow
        return None


def png_chunks(path: Path) -> Iterator[tuple[bytes, bytes]]:
    """Yield the kind and content of each chunk of a PNG file; nothing for other files.

    Raises InputError for missing bytes and wrong checksums, which OpenImageIO does not report reliably.
    """
    size = path.stat().st_size
    with path.open("rb") as stream:
        kind = b"" if stream.read(len(_PNG_SIGNATURE)) == _PNG_SIGNATURE else b"IEND"
        while kind != b"IEND":
            head = stream.read(8)
            length, kind = struct.unpack(">I4s", head) if len(head) == 8 else (0, b"")
            body, checksum = stream.read(min(length, size)), stream.read(4)  # a length may be 4 GiB
            if len(body) != length or len(checksum) != 4:
                raise InputError(f"{path}: damaged or cut short: the PNG file ends too early; copy it again")
            if zlib.crc32(kind + body) != int.from_bytes(checksum, "big"):
                raise InputError(f"{path}: damaged: a checksum of the PNG file is wrong; copy it again")
            yield kind, body


def lacks_alpha(form: str, spec: oiio.ImageSpec) -> bool:
    """Return whether the fourth channel of a TGA is not alpha."""
    is_open = form == "targa" and not spec.get_int_attribute("oiio:UnassociatedAlpha", 0)
    return is_open and spec.get_int_attribute("targa:alpha_type", 0) != _TGA_ALPHA


def is_associated(path: Path, form: str, spec: oiio.ImageSpec) -> bool:
    """Return whether the colour is multiplied by alpha."""
    if form not in _ASSOCIATED or spec.get_int_attribute("oiio:UnassociatedAlpha", 0):
        return False
    if form != "tiff":
        return True
    # OpenImageIO assumes it without the tag. Pillow opens few files with alpha, but reads their directory.
    from PIL.TiffImagePlugin import ImageFileDirectory_v2

    with path.open("rb") as stream:
        start = stream.read(16)
        directory = ImageFileDirectory_v2(start if 43 in start[2:4] else start[:8])  # 43: BigTIFF
        stream.seek(directory.next)
        directory.load(stream)
        return bool(directory.get(_EXTRA_SAMPLES, (0,))[0] == _ASSOCIATED_ALPHA)


def radiance_exposure(path: Path, spec: oiio.ImageSpec) -> float:
    """Return the factor of a Radiance file's values, and set `chromaticities` from its PRIMARIES.

    The header, lines `NAME=value`, ends with an empty line and the resolution, `-Y 512 +X 1024`. Raises
    InputError for damage, and for files that OpenImageIO misreads.
    """
    with path.open("rb") as stream:
        start = stream.read(_HEADER_BYTES)
    header, _, rest = start.partition(b"\n\n")
    resolution, _, values = rest.partition(b"\n")
    lines = re.findall(
        r"^\s*(EXPOSURE|PRIMARIES|COLORCORR|PIXASPECT)\s*=(.*)$", header.decode("latin-1"), re.M
    )
    try:
        numbers = [(name, float(word)) for name, text in lines for word in text.split()]
    except ValueError:
        numbers = [("EXPOSURE", math.nan)]
    exposure = math.prod(number for name, number in numbers if name == "EXPOSURE")
    primaries = [number for name, number in numbers if name == "PRIMARIES"]
    is_corrected = any(number != 1 for name, number in numbers if name in ("COLORCORR", "PIXASPECT"))
    stored = path.stat().st_size - (len(start) - len(values))
    has_runs = values.startswith(b"\2\2" + (spec.width & 0xFFFF).to_bytes(2, "big"))
    for is_rare, message in (
        (not 0 < exposure < math.inf or (any(primaries) and len(primaries) != 8), "damaged Radiance header"),
        (is_corrected, "COLORCORR and PIXASPECT of Radiance files are not supported"),
        # OpenImageIO rotates these incorrectly.
        (re.match(rb"\+X +\d+ +\+Y|-X +\d+ +-Y", resolution), "this column order is not supported"),
        (
            stored < 4 * spec.width * spec.height and not has_runs,
            "a Radiance file in old-style runs, or cut short, is not supported",
        ),
    ):
        if is_rare:
            raise InputError(f"{path}: {message}; save it as EXR in an image editor")
    if any(primaries):  # Poly Haven's maps have zeros
        spec.attribute("chromaticities", oiio.TypeDesc("float[8]"), tuple(primaries))
    return exposure


def read_in_one_thread() -> None:
    """Make OpenImageIO read images in the calling thread, also in processes forked later.

    A forked process lacks the threads that OpenImageIO has started, and would wait for them forever.
    """
    oiio.attribute("threads", 1)


def utf8_path(path: Path) -> str:
    """Return the path for OpenImageIO, which takes only UTF-8; raise InputError for other names."""
    try:
        path.as_posix().encode()
    except UnicodeEncodeError:
        raise InputError(f"{str(path)!a}: the name is not UTF-8; rename the file or its folder") from None
    return str(path)


def oiio_error(stream: Any = oiio) -> str:
    """Return and clear the pending error of OpenImageIO or one of its streams, which may not be UTF-8.

    OpenImageIO prints pending errors when the program ends.
    """
    try:
        return str(stream.geterror())
    except UnicodeDecodeError as error:
        return error.object.decode(errors="replace")


def reason(path: Path, message: str) -> str:
    """Shorten OpenImageIO's error message to its first line, without the path."""
    line = (message.strip().splitlines() or [""])[0]
    line = re.sub(r' \("?' + re.escape(str(path)) + r'"?\)', "", line).replace(f'"{path}"', "it")
    return one_line(re.sub(r"\bEXR_ERR_\w+ |: magic 0x.*| Is it a file format .*", "", line))


def require_whole(path: Path, values: np.ndarray | None, report: str) -> None:
    """Raise InputError unless values were decoded; `report` is OpenImageIO's error text."""
    message = reason(path, report)
    if values is None and _UNSUPPORTED.search(message):
        raise InputError(f"{path}: its compression is not supported; save it with another ({message})")
    if values is None or "premature end" in report.lower():  # a truncated JPEG decodes to grey
        raise InputError(f"{path}: damaged or cut short; copy it again ({message or 'no pixels in it'})")
    if message:
        log.warning("%s: %s", path, message)


def looks_multiplied(values: np.ndarray, colour: list[int], alpha: int) -> bool:
    """Return whether the colour of [H, W, C] rarely exceeds alpha where alpha is neither 0 nor 1."""
    coverage = unit_floats(values[..., alpha])
    soft = (coverage > 0) & (coverage < 1)
    is_above = unit_floats(values[soft][:, colour].max(-1)) > coverage[soft] + _NOISE
    return bool(soft.any()) and float(is_above.mean()) < _MOST_ABOVE
