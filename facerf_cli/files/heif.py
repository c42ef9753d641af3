"""HEIC and HEIF photos, as phones store them; decoded by pi-heif, an extra (`facerf[heic]`).

Some damaged files crash pi-heif, so it runs in a process of its own (`files/apart.py`).
"""

import importlib.util
from pathlib import Path

import numpy as np
import OpenImageIO as oiio

from facerf_cli.errors import InputError
from facerf_cli.files.apart import arrays_apart
from facerf_cli.run import memory

HEIF_BYTES = 12  # of a pixel that is decoded in another process: 16 bits, there and here
_BRANDS = (b"heic", b"heix", b"hevc", b"heim", b"heis", b"mif1", b"msf1")
_FULL_RANGE = 1  # to which pi-heif decodes
PIXELS, PROFILE, CODES, SIZE, ASSOCIATED = "pixels", "profile", "codes", "size", "associated"


def heif_arrays(path: Path, limit_px: int, most_px: int) -> dict[str, np.ndarray]:
    """The main image, upright, [H, W, C] uint8 or uint16, and its ICC profile or its colour's code points.

    Of an image of more than `most_px` pixels only the size (W, H); over `limit_px` is a ValueError.
    """
    import pi_heif

    image = pi_heif.open_heif(path, convert_hdr_to_8bit=False)
    width, height = image.size
    if width * height > limit_px:
        most = f"at most {limit_px / 1e6:.0f} megapixels are read"
        raise ValueError(f"{width} x {height} pixels; {most}, so make it smaller")
    if width * height > most_px:
        return {SIZE: np.array([width, height])}
    pixels = np.array(image)  # a copy: the memory of pi-heif ends with its image
    arrays = {
        PIXELS: pixels.reshape(height, width, -1),
        ASSOCIATED: np.array(bool(image.premultiplied_alpha)),
    }
    if profile := image.info.get("icc_profile"):
        arrays[PROFILE] = np.frombuffer(profile, np.uint8)
    elif code := image.info.get("nclx_profile"):
        arrays[CODES] = np.array([code["color_primaries"], code["transfer_characteristics"]])
    return arrays


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
        arrays = arrays_apart(heif_arrays, path, limit_px, memory.left_bytes() // bytes_px)
    except ValueError as error:
        raise InputError(f"{path}: not a readable image; save it again as JPEG ({error})") from None
    if SIZE in arrays:
        width, height = arrays[SIZE].tolist()
        memory.require(f"{path}: {width} x {height} pixels", width * height * bytes_px, "make it smaller")
    values = arrays[PIXELS]
    height, width, channels = values.shape
    spec = oiio.ImageSpec(width, height, channels, str(values.dtype))
    spec.attribute("oiio:UnassociatedAlpha", int(not arrays[ASSOCIATED]))
    if PROFILE in arrays:
        content = arrays[PROFILE]
        spec.attribute("ICCProfile", oiio.TypeDesc(f"uint8[{len(content)}]"), content)
    elif CODES in arrays:
        spec.attribute("CICP", oiio.TypeDesc("int[4]"), (*arrays[CODES].tolist(), 0, _FULL_RANGE))
    return values, spec
