"""HEIC and HEIF photos, as phones store them; decoded by pi-heif, an extra (`facerf[heic]`)."""

from pathlib import Path
from typing import Any

import numpy as np
import OpenImageIO as oiio

from facerf_cli.errors import InputError

_BRANDS = (b"heic", b"heix", b"hevc", b"heim", b"heis", b"mif1", b"msf1")
# Colour spaces by the code points of primaries and transfer function (ITU-T H.273), where no ICC profile is.
_SPACES = {(1, 13): "sRGB", (1, 1): "sRGB", (12, 13): "Display P3", (2, 2): "sRGB"}


def is_heif(path: Path) -> bool:
    """True if a file begins as a HEIF file does, whatever its suffix: phones also name them .jpg."""
    with path.open("rb") as stream:
        start = stream.read(12)
    return start[4:8] == b"ftyp" and start[8:] in _BRANDS


def heif_header(path: Path) -> tuple[Any, oiio.ImageSpec]:
    """Open a HEIF file: its main image, not decoded yet, and its upright size and colour space."""
    try:
        import pi_heif
    except ImportError:
        raise InputError(
            f"{path}: HEIC and HEIF need the package pi-heif; pip install 'facerf[heic]', or save it as JPEG"
        ) from None
    try:
        image = pi_heif.open_heif(path, convert_hdr_to_8bit=False)
    except (ValueError, EOFError, SyntaxError, RuntimeError, OSError) as error:
        raise InputError(f"{path}: not a readable image; save it again as JPEG ({error})") from None
    width, height = image.size
    channels = len(image.mode.split(";")[0]) if image.mode.startswith("RGB") else 1
    spec = oiio.ImageSpec(width, height, channels, "uint16" if image.mode.endswith(";16") else "uint8")
    spec.attribute("oiio:UnassociatedAlpha", 1)
    if profile := image.info.get("icc_profile"):
        content = np.frombuffer(profile, np.uint8)
        spec.attribute("ICCProfile", oiio.TypeDesc(f"uint8[{len(content)}]"), content)
    elif code := image.info.get("nclx_profile"):
        key = code["color_primaries"], code["transfer_characteristics"]
        spec.attribute("oiio:ColorSpace", _SPACES.get(key, f"CICP {key[0]}-{key[1]}"))
    return image, spec


def decode_heif(path: Path, image: Any, spec: oiio.ImageSpec) -> np.ndarray:
    """Decode all channels [H, W, C] of the main image, upright, as integers."""
    try:
        values = np.asarray(image)
    except (ValueError, EOFError, SyntaxError, RuntimeError, OSError) as error:
        raise InputError(f"{path}: damaged or cut short; copy it again ({error})") from None
    return values.reshape(spec.height, spec.width, spec.nchannels)
