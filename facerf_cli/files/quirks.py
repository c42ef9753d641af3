"""What OpenImageIO leaves to its caller: refusing rare kinds of files, finding damage, parts of headers.

A header of Radiance's .hdr, lines `NAME=value`, ends with an empty line and the resolution, `-Y 512 +X 1024`.
HEIC and AVIF are in `isobmff.py`.
"""

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
UNDEVELOPED = (  # OpenImageIO reads its thumbnail
    "a raw file of a camera, or a thumbnail first, is not read; develop it to EXR, TIFF or JPEG, as with"
    " darktable or RawTherapee"
)
_NO_COMPOSITE = (
    "a PSD without a composite of its layers is not read; save it with Maximize Compatibility, or as PNG"
)
ASSOCIATED = 1  # kind of a TIFF's extra channel: alpha that the colour is multiplied by
_EXTRA_SAMPLES = 338  # the tag of these kinds
# A TIFF's photometric interpretations.
_WHITE_IS_ZERO, _SEPARATED, _CIELAB, _RAW_COLOURS = 0, 5, 8, (32803, 34892)
_THUMBNAIL = 1  # bit of a TIFF's NewSubfileType
_FILM_CURVES = ("Logarithmic", "Printing density")  # of a DPX
_PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"
_PSD_VERSION, _HAS_COMPOSITE = 1057, 4  # a PSD's resource, and the place of a byte in it
_HEADER_BYTES = 1 << 16  # of a Radiance file
_NOISE, _MOST_ABOVE = 0.01, 0.02  # of multiplied colours: how far, and how many pixels, exceed alpha
_UNSUPPORTED = re.compile(
    r"unsupported|not (supported|configured|implemented|available)|unknown compression", re.I
)

log = logging.getLogger(LOGGER_NAME)


def refuse_rare(path: Path, form: str, spec: oiio.ImageSpec, following: oiio.ImageSpec | None) -> None:
    """Raise InputError for kinds of files that few people have; the error names the conversion.

    `form` is OpenImageIO's name of the format, `spec` the header of the image that would be read, and
    `following` the header of a TIFF's second page.
    """
    meaning = spec.get_int_attribute("tiff:PhotometricInterpretation", -1)
    is_log = form == "cineon" or spec.get_string_attribute("dpx:Transfer") in _FILM_CURVES
    is_turned = form == "dpx" and spec.get_int_attribute("Orientation", 1) >= 5
    for is_found, message in (
        (spec.deep, "a deep image is not read; flatten it, as with oiiotool --flatten"),
        (form == "tiff" and _is_raw(path, spec, following), UNDEVELOPED),
        (meaning == _WHITE_IS_ZERO, "a TIFF whose zero is white is not read; save it as PNG"),
        (meaning == _CIELAB, "a TIFF in CIELAB is not read; convert it to RGB"),
        (form == "psd" and _lacks_composite(path), _NO_COMPOSITE),
        (is_log, "a film scan in Cineon log is not read; convert it to linear values, as EXR"),
        (is_turned, "a DPX file that lies on its side is not read; save it upright"),
    ):
        if is_found:
            raise InputError(f"{path}: {message}")


def has_inks(spec: oiio.ImageSpec) -> bool:
    """Return whether a JPEG or TIFF holds inks (CMYK)."""
    is_separated = spec.get_int_attribute("tiff:PhotometricInterpretation", -1) == _SEPARATED
    return is_separated or spec.get_string_attribute("jpeg:ColorSpace") in ("CMYK", "YCbCrK")


def _is_raw(path: Path, spec: oiio.ImageSpec, following: oiio.ImageSpec | None) -> bool:
    """Return whether a TIFF has a thumbnail first, before its next image, or the values of a sensor."""
    is_thumbnail = bool(spec.get_int_attribute("tiff:subfiletype", 0) & _THUMBNAIL)
    is_smaller = following is not None and 2 * spec.width <= following.width
    colours = spec.get_int_attribute("tiff:PhotometricInterpretation", -1)
    return starts_with(path, b"CR", 8) or is_thumbnail or is_smaller or colours in _RAW_COLOURS


def _lacks_composite(path: Path) -> bool:
    """Return whether a PSD says that it has white in place of its layers."""
    resources = by_pillow(path, lambda image: {number: data for number, _, data in image.resources}) or {}
    return bool(resources.get(_PSD_VERSION, b"")[_HAS_COMPOSITE:][:1] == b"\0")


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


def png_chunks(path: Path) -> Iterator[tuple[bytes, bytes]]:
    """Yield the kind and the content of each chunk of a PNG file; nothing for a file of another kind.

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


def extra_channel(path: Path) -> int:
    """Return the kind of a TIFF's first channel after its colours, such as `ASSOCIATED`; 0 if none is stated.

    Pillow opens few of the files with such a channel, but reads their directory.
    """
    from PIL.TiffImagePlugin import ImageFileDirectory_v2

    with path.open("rb") as stream:
        start = stream.read(16)
        directory = ImageFileDirectory_v2(start if 43 in start[2:4] else start[:8])  # 43: BigTIFF
        stream.seek(directory.next)
        directory.load(stream)
        return int(directory.get(_EXTRA_SAMPLES, (0,))[0])


def radiance_exposure(path: Path, spec: oiio.ImageSpec) -> float:
    """Return what the values of a Radiance file were multiplied by, and set the primaries that it states.

    Raises InputError for a damaged header, and for a file that OpenImageIO reads otherwise than meant.
    """
    with path.open("rb") as stream:
        start = stream.read(_HEADER_BYTES)
    header, _, rest = start.partition(b"\n\n")
    resolution, _, values = rest.partition(b"\n")
    exposure, primaries = 1.0, list[float]()
    try:
        for name, text in re.findall(r"^\s*(\w+)\s*=(.*)$", header.decode("latin-1"), re.MULTILINE):
            if name == "EXPOSURE":
                exposure *= float(text)
            elif name == "PRIMARIES":
                primaries = [float(word) for word in text.split()]
            elif name in ("COLORCORR", "PIXASPECT") and any(float(word) != 1 for word in text.split()):
                raise ValueError(f"{name} is not read; save it as EXR without it")
        if not 0 < exposure < math.inf or (any(primaries) and len(primaries) != 8):
            raise ValueError("a number in it is out of range")
        if re.match(rb"\+X +\d+ +\+Y|-X +\d+ +-Y", resolution):  # which OpenImageIO turns wrong
            raise ValueError("columns of this order are not read; turn it with Radiance's protate")
    except ValueError as error:
        raise InputError(f"{path}: the header of a Radiance file is wrong: {error}") from None
    if any(primaries):  # not all 0, as in the maps of Poly Haven
        spec.attribute("chromaticities", oiio.TypeDesc("float[8]"), tuple(primaries))
    stored = path.stat().st_size - (len(start) - len(values))
    has_runs = values.startswith(b"\2\2" + (spec.width & 0xFFFF).to_bytes(2, "big"))
    if stored < 4 * spec.width * spec.height and not has_runs:
        kind = "a Radiance file in old-style runs, or cut short,"
        raise InputError(f"{path}: {kind} is not read; save it as EXR with an image editor")
    return exposure


def read_in_one_thread() -> None:
    """Let images be read by the thread that asks, also in processes that are forked from now on.

    A forked process has none of the threads that OpenImageIO has begun; on a machine of many cores it would
    wait for them without end.
    """
    oiio.attribute("threads", 1)


def utf8_path(path: Path) -> str:
    """Return the path for OpenImageIO, which takes only UTF-8; raise an InputError for any other name."""
    try:
        path.as_posix().encode()
    except UnicodeEncodeError:
        raise InputError(
            f"{str(path)!a}: the name is not UTF-8; rename the file, or the folder that it is in"
        ) from None
    return str(path)


def oiio_error(stream: Any = oiio) -> str:
    """Take the pending error of OpenImageIO, or of one of its streams, which need not be UTF-8.

    OpenImageIO prints an error that nobody took when the program ends.
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


def require_whole(path: Path, values: np.ndarray | None, said: str) -> None:
    """Raise InputError unless values were decoded; `said` is what OpenImageIO reported as it did."""
    message = reason(path, said)
    if values is None and _UNSUPPORTED.search(message):
        raise InputError(f"{path}: its compression is not supported; save it with another ({message})")
    if values is None or "premature end" in said.lower():  # a JPEG cut short decodes to grey
        raise InputError(f"{path}: damaged or cut short; copy it again ({message or 'no pixels in it'})")
    if message:
        log.warning("%s: %s", path, message)


def looks_multiplied(values: np.ndarray, colour: list[int], alpha: int) -> bool:
    """Return whether the colour of [H, W, C] hardly exceeds alpha where that is neither 0 nor 1."""
    cover = unit_floats(values[..., alpha])
    soft = (cover > 0) & (cover < 1)
    above = unit_floats(values[soft][:, colour].max(-1)) > cover[soft] + _NOISE
    return bool(soft.any()) and float(above.mean()) < _MOST_ABOVE
