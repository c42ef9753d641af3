"""AVIF images: 8 bits by Pillow; 10 and 12 bits keep their depth by PyAV, an extra (`facerf[video]`)."""

import importlib.util
import io
import logging
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import OpenImageIO as oiio

from facerf_cli.errors import InputError
from facerf_cli.run.logs import LOGGER_NAME, one_line

AVIF_BYTES = 24  # of a pixel while it is decoded: 16 bits in planes, in one array, and scaled
_BRANDS = (b"avif", b"avis")
_START_BYTES = 64  # in which a file names its brands
_DEEP, _TWELVE = 0x40, 0x20  # bits of an av1C box
_ORIENTATION = 0x0112  # of Exif
_UNKNOWN, _BT601 = 2, 5  # matrices (ITU-T H.273), and
_MATRICES = (1, 4, _BT601, 6, 7, 9)  # those that FFmpeg converts
_FULL = 1  # range
_MOST = np.iinfo(np.uint16).max

log = logging.getLogger(LOGGER_NAME)


def is_avif(path: Path) -> bool:
    """True if a file begins as an AVIF file does, whatever its suffix."""
    with path.open("rb") as stream:
        start = stream.read(_START_BYTES)
    brands = start[8 : int.from_bytes(start[:4], "big")]
    return start[4:8] == b"ftyp" and any(brands[at : at + 4] in _BRANDS for at in range(0, len(brands), 4))


def open_avif(path: Path) -> tuple[Any, oiio.ImageSpec]:
    """Open the main image by Pillow without decoding it, and describe it: size, depth, colour space."""
    try:
        from PIL.AvifImagePlugin import SUPPORTED, AvifImageFile
    except ImportError:
        SUPPORTED = False
    if not SUPPORTED:
        raise InputError(f"{path}: AVIF needs Pillow 11.3 or later; pip install -U pillow, or save it as PNG")
    content = path.read_bytes()
    try:
        image = AvifImageFile(io.BytesIO(content))  # Image.open limits the size
        orientation = image.getexif().get(_ORIENTATION, 1)
    except Exception as error:  # whatever damage makes Pillow raise
        raise _damaged(path, error) from None
    bits, codes, is_associated = _stated(content)
    spec = oiio.ImageSpec(*image.size, len(image.mode), "uint8" if bits == 8 else "uint16")
    spec.attribute("oiio:BitsPerSample", bits)
    spec.attribute("oiio:UnassociatedAlpha", int(not is_associated))
    spec.attribute("Orientation", orientation if orientation in range(1, 9) else 1)
    if profile := image.info.get("icc_profile"):
        values = np.frombuffer(profile, np.uint8)
        spec.attribute("ICCProfile", oiio.TypeDesc(f"uint8[{len(profile)}]"), values)
    elif codes:
        spec.attribute("CICP", oiio.TypeDesc("int[4]"), (*codes, 0, _FULL))
    return image, spec


def decode_avif(path: Path, image: Any, spec: oiio.ImageSpec) -> np.ndarray:
    """Decode an opened image [H, W, C] uint8, or uint16 where it is deeper, not upright."""
    shape, bits = (spec.height, spec.width, -1), spec.get_int_attribute("oiio:BitsPerSample")
    if bits > 8 and (values := _deep_values(image)) is not None:
        return values.reshape(shape)
    try:
        values = np.asarray(image)
    except Exception as error:
        raise _damaged(path, error) from None
    spec.attribute("oiio:UnassociatedAlpha", 1)  # Pillow divides by alpha
    if bits > 8:
        advice = "" if importlib.util.find_spec("av") else "; pip install 'facerf[video]' to keep them"
        log.warning("%s: has %d bits, read as 8 bits%s", path, bits, advice)
    return values.reshape(shape)


def _damaged(path: Path, error: Exception) -> InputError:
    return InputError(f"{path}: damaged or cut short; copy it again ({one_line(str(error))})")


def _deep_values(image: Any) -> np.ndarray | None:
    """Colour and alpha [H, W, C] uint16; None without PyAV, and for what it does not read whole."""
    try:
        import av
    except ImportError:
        return None

    def frame_of(number: int) -> Any:
        with av.open(io.BytesIO(image.fp.getvalue()), "r") as container:
            frame = next(container.decode(container.streams.video[number]))
        if (frame.width, frame.height) != image.size:
            raise ValueError("a tile")
        return frame

    try:
        frame = frame_of(0)
        name, bits, is_limited = frame.format.name, frame.format.components[0].bits, frame.color_range == 1
        matrix = _BT601 if frame.colorspace == _UNKNOWN else int(frame.colorspace)
        if name.startswith("gbr"):
            values, white = frame.to_ndarray(format="rgb48le"), _MOST
        elif matrix in _MATRICES and not (name.startswith("gray") and is_limited):
            values = frame.to_ndarray(format="rgb48le", src_colorspace=matrix)
            white = 255 << 8 if is_limited else ((1 << bits) - 1) << (16 - bits)  # as it comes from FFmpeg
        else:
            return None
        values = (values * np.float32(_MOST / white)).round().clip(max=_MOST).astype(np.uint16)
        alpha = [frame_of(1).to_ndarray(format="gray16le")] if image.mode == "RGBA" else []
        return np.dstack([values[..., : min(len(image.mode), 3)], *alpha])
    except (av.error.FFmpegError, OSError, ValueError, IndexError, StopIteration):
        return None


def _stated(content: bytes) -> tuple[int, tuple[int, int] | None, bool]:
    """Bits of a value, codes of primaries and curve, and if alpha is multiplied in, by ISO 23008-12."""
    try:
        meta = dict(boxes(dict(boxes(content))[b"meta"][4:]))
        properties = dict(_properties(meta[b"pitm"], dict(boxes(meta[b"iprp"]))))
        flags = properties.get(b"av1C", bytes(4))[2]
        bits = (12 if flags & _TWELVE else 10) if flags & _DEEP else 8
        bits = max([bits, *properties.get(b"pixi", b"")[5:]])
        colours = properties.get(b"colr", b"")
        codes = struct.unpack_from(">HH", colours, 4) if colours[:4] == b"nclx" else None
        return bits, codes, b"prem" in dict(boxes(meta.get(b"iref", b"")[4:]))
    except (KeyError, IndexError, struct.error):
        return 8, None, False


def boxes(content: bytes) -> Iterator[tuple[bytes, bytes]]:
    """Yield the kind and the content of each box (ISO 14496-12) in order."""
    at = 0
    while at + 8 <= len(content):
        size, kind = struct.unpack_from(">I4s", content, at)
        head = 8
        if size == 1:
            (size,), head = struct.unpack_from(">Q", content, at + head), 16
        end = at + size if size else len(content)
        if end < at + head:
            return
        yield kind, content[at + head : end]
        at = end


def _properties(primary: bytes, inside: dict[bytes, bytes]) -> Iterator[tuple[bytes, bytes]]:
    """Yield the properties of the primary item, by the boxes `ipco` and `ipma`."""
    every, table = list(boxes(inside[b"ipco"])), inside[b"ipma"]
    main = int.from_bytes(primary[4 : 8 if primary[0] else 6], "big")
    of_item, of_index = (4 if table[0] else 2), 1 + (table[3] & 1)
    at = 8
    while at < len(table):
        item, count = int.from_bytes(table[at : at + of_item], "big"), table[at + of_item]
        at += of_item + 1
        for place in range(at, at + of_index * count, of_index) if item == main else ():
            index = int.from_bytes(table[place : place + of_index], "big") & ((1 << 8 * of_index - 1) - 1)
            yield every[index - 1]
        at += of_index * count
