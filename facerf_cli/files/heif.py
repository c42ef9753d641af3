"""HEIC and HEIF photos, as phones store them; decoded by pi-heif, an extra (`facerf[heic]`)."""

import importlib.util
from pathlib import Path

import numpy as np
import OpenImageIO as oiio

from facerf_cli.errors import InputError
from facerf_cli.files.apart import arrays_apart
from facerf_cli.files.heif_arrays import CODES, PIXELS, PROFILE, SIZE
from facerf_cli.run import memory

HEIF_BYTES = 12  # of a pixel that is decoded in another process: 16 bits, there and here
_READERS = "facerf_cli.files.heif_arrays"  # in a process of their own
_BRANDS = (b"heic", b"heix", b"hevc", b"heim", b"heis", b"mif1", b"msf1")
# Colour spaces by the code points of primaries and transfer function (ITU-T H.273), where no ICC profile is.
_SPACES = {(1, 13): "sRGB", (1, 1): "sRGB", (12, 13): "Display P3", (2, 2): "sRGB"}


def is_heif(path: Path) -> bool:
    """True if a file begins as a HEIF file does, whatever its suffix: phones also name them .jpg."""
    with path.open("rb") as stream:
        start = stream.read(12)
    return start[4:8] == b"ftyp" and start[8:] in _BRANDS


def decode_heif(path: Path, limit_px: int, bytes_px: int = HEIF_BYTES) -> tuple[np.ndarray, oiio.ImageSpec]:
    """Decode the main image [H, W, C], upright, as integers; and its size and colour space.

    The size is checked, and the budget of memory asked for `bytes_px` bytes a pixel, before it is decoded.
    """
    if importlib.util.find_spec("pi_heif") is None:
        raise InputError(
            f"{path}: HEIC and HEIF need the package pi-heif; pip install 'facerf[heic]', or save it as JPEG"
        )
    try:
        arrays = arrays_apart(_READERS, "heif_arrays", path, limit_px, memory.left_bytes() // bytes_px)
    except ValueError as error:
        raise InputError(f"{path}: not a readable image; save it again as JPEG ({error})") from None
    if SIZE in arrays:
        width, height = arrays[SIZE].tolist()
        memory.require(f"{path}: {width} x {height} pixels", width * height * bytes_px, "make it smaller")
    values = arrays[PIXELS]
    height, width, channels = values.shape
    spec = oiio.ImageSpec(width, height, channels, str(values.dtype))
    spec.attribute("oiio:UnassociatedAlpha", 1)
    if PROFILE in arrays:
        content = arrays[PROFILE]
        spec.attribute("ICCProfile", oiio.TypeDesc(f"uint8[{len(content)}]"), content)
    elif CODES in arrays:
        key = tuple(arrays[CODES].tolist())
        spec.attribute("oiio:ColorSpace", _SPACES.get(key, f"CICP {key[0]}-{key[1]}"))
    return values, spec
