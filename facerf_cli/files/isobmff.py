"""HEIC and AVIF: images in ISO boxes (ISO 14496-12), which OpenImageIO does not read.

HEIC and HEIF, the formats of phones, are decoded by pi-heif, an extra (`facerf[heic]`), in a separate process
(`sandbox.py`), because some damaged files crash it. AVIF is decoded by Pillow in 8 bits; with PyAV, an extra
(`facerf[video]`), 10 and 12 bits keep their depth. Values are integers [H, W, C] as stored.
"""

import importlib.util
import io
import logging
import re
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import OpenImageIO as oiio

from facerf_cli.errors import InputError
from facerf_cli.files.sandbox import read_in_subprocess
from facerf_cli.run.logs import LOGGER_NAME, one_line

# Bytes per pixel during decoding: 16 bits in both processes; 16 bits in planes, in one array, and scaled.
HEIF_BYTES, AVIF_BYTES = 12, 24
_HEIF_BRANDS = (b"heic", b"heix", b"hevc", b"heim", b"heis", b"mif1", b"msf1")
_AVIF_BRANDS = (b"avif", b"avis")
_START_BYTES = 64  # of a file, with its brands
_DEEP, _TWELVE = 0x40, 0x20  # bits of an av1C box
_ORIENTATION = 0x0112  # in Exif
_UNKNOWN, _BT601 = 2, 5  # matrices (ITU-T H.273)
_MATRICES = (1, 4, _BT601, 6, 7, 9)  # supported by FFmpeg
_FULL = 1  # the range to which pi-heif and Pillow decode
_MOST = np.iinfo(np.uint16).max

log = logging.getLogger(LOGGER_NAME)
OpenImage = tuple[oiio.ImageSpec, Callable[[], np.ndarray]]  # header, and a function that decodes [H, W, C]


def kind_of(path: Path) -> str:
    """Return "avif" or "heif" by a file's first bytes, whatever its suffix; "" for other files."""
    with path.open("rb") as stream:
        start = stream.read(_START_BYTES)
    brands = start[8 : int.from_bytes(start[:4], "big")]
    if start[4:8] != b"ftyp":
        return ""
    if any(brands[at : at + 4] in _AVIF_BRANDS for at in range(0, len(brands), 4)):
        return "avif"
    return "heif" if start[8:12] in _HEIF_BRANDS else ""


def _set_colour(spec: oiio.ImageSpec, is_associated: bool, profile: Any, codes: Any) -> None:
    """Set the attributes that OpenImageIO would: alpha, and a profile, or else codes of the space."""
    spec.attribute("oiio:UnassociatedAlpha", int(not is_associated))
    if profile is not None:
        spec.attribute(
            "ICCProfile", oiio.TypeDesc(f"uint8[{len(profile)}]"), np.frombuffer(profile, np.uint8)
        )
    elif codes is not None:
        spec.attribute("CICP", oiio.TypeDesc("int[4]"), (*map(int, codes), 0, _FULL))


def heif_arrays(path: Path, most_px: int) -> dict[str, np.ndarray]:
    """Read the upright main image: `shape` [H, W, C], `bits`, and ICC `profile` or `codes` of its space.

    `pixels` [H, W, C] are included only up to `most_px` pixels.
    """
    import pi_heif

    image = pi_heif.open_heif(path, convert_hdr_to_8bit=False)
    width, height = image.size
    channels, _, depth = image.mode.partition(";")
    arrays = {
        "shape": np.array([height, width, len(channels)]),
        "bits": np.array(16 if depth else 8),
        "is_associated": np.array(bool(image.premultiplied_alpha)),
    }
    if profile := image.info.get("icc_profile"):
        arrays["profile"] = np.frombuffer(profile, np.uint8)
    elif code := image.info.get("nclx_profile"):
        arrays["codes"] = np.array([code["color_primaries"], code["transfer_characteristics"]])
    if width * height <= most_px:
        arrays["pixels"] = np.array(image).reshape(height, width, -1)  # a copy: pi-heif owns its memory
    return arrays


def open_heif(path: Path, most_px: int) -> OpenImage:
    """Open the upright main image; above `most_px` pixels it cannot be decoded."""
    if importlib.util.find_spec("pi_heif") is None:
        raise InputError(
            f"{path}: HEIC and HEIF need the package pi-heif; pip install 'facerf[heic]', or save it as JPEG"
        )
    try:
        arrays = read_in_subprocess(heif_arrays, path, most_px)
    except ValueError as error:
        raise InputError(f"{path}: not a readable image; save it as JPEG ({error})") from None
    height, width, channels = arrays["shape"].tolist()
    spec = oiio.ImageSpec(width, height, channels, f"uint{arrays['bits']}")
    _set_colour(spec, bool(arrays["is_associated"]), arrays.get("profile"), arrays.get("codes"))
    return spec, lambda: arrays["pixels"]


def open_avif(path: Path) -> OpenImage:
    """Open the main image, as stored, with Pillow."""
    from PIL.AvifImagePlugin import SUPPORTED, AvifImageFile

    if not SUPPORTED:
        raise InputError(f"{path}: this Pillow lacks AVIF; pip install -U pillow, or save it as PNG")
    content = path.read_bytes()
    try:
        image = AvifImageFile(io.BytesIO(content))  # Image.open limits the size
        orientation = image.getexif().get(_ORIENTATION, 1)
    except Exception as error:  # any exception that damage causes in Pillow
        raise _damaged(path, error) from None
    bits, codes, is_associated = _stated(content)
    spec = oiio.ImageSpec(*image.size, len(image.mode), "uint8" if bits == 8 else "uint16")
    _set_colour(spec, is_associated, image.info.get("icc_profile") or None, codes)
    spec.attribute("Orientation", orientation if orientation in range(1, 9) else 1)

    def decode() -> np.ndarray:
        if bits > 8 and (values := _deep_values(image)) is not None:
            return values
        try:
            values = np.asarray(image).reshape(spec.height, spec.width, -1)
        except Exception as error:  # as above
            raise _damaged(path, error) from None
        spec.attribute("oiio:UnassociatedAlpha", 1)  # Pillow divides by alpha
        if bits > 8:
            advice = "" if importlib.util.find_spec("av") else "; pip install 'facerf[video]' to keep them"
            log.warning("%s: has %d bits, read as 8 bits%s", path, bits, advice)
        return values

    return spec, decode


def _damaged(path: Path, error: Exception) -> InputError:
    return InputError(f"{path}: damaged or cut short; copy it again ({one_line(str(error))})")


def _deep_values(image: Any) -> np.ndarray | None:
    """Decode colour and alpha [H, W, C] uint16; None without PyAV, and for files that PyAV reads in part."""
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
            white = 255 << 8 if is_limited else ((1 << bits) - 1) << (16 - bits)  # FFmpeg's white
        else:
            return None
        values = (values * np.float32(_MOST / white)).round().clip(max=_MOST).astype(np.uint16)
        alpha = [frame_of(1).to_ndarray(format="gray16le")] if image.mode == "RGBA" else []
        return np.dstack([values[..., : min(len(image.mode), 3)], *alpha])
    except (av.error.FFmpegError, OSError, ValueError, IndexError, StopIteration):
        return None


def _stated(content: bytes) -> tuple[int, tuple[int, int] | None, bool]:
    """Return bits per value, codes of primaries and curve, and True for premultiplied alpha (ISO 23008-12).

    In the list of properties (ipco), those of the main image precede those of its alpha and thumbnails.
    """
    configuration = re.search(rb"ipco.*?av1C..(.)", content, re.DOTALL)
    codes = re.search(rb"ipco.*?colrnclx(.{4})", content, re.DOTALL)
    flags = configuration[1][0] if configuration else 0
    bits = (12 if flags & _TWELVE else 10) if flags & _DEEP else 8
    is_associated = re.search(rb"iref.*?prem..\x00\x01", content, re.DOTALL) is not None
    return bits, struct.unpack(">HH", codes[1]) if codes else None, is_associated
