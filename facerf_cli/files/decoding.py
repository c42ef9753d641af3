"""Image files as they are stored: decoded to arrays, the choice of channels, the frame, the orientation."""

import logging
import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import OpenImageIO as oiio

from facerf_cli.errors import InputError
from facerf_cli.files.heif import HEIF_BYTES, decode_heif, is_heif
from facerf_cli.files.image_metadata import is_ultra_hdr, oiio_error, require_whole_png, utf8_path
from facerf_cli.files.regular import require_regular
from facerf_cli.run import memory
from facerf_cli.run.logs import LOGGER_NAME, one_line

log = logging.getLogger(LOGGER_NAME)


_INTEGERS = (oiio.TypeDesc(oiio.UINT8), oiio.TypeDesc(oiio.UINT16))
_LINEAR_BYTES = 12  # of a pixel that is read: three floats, and
_ALPHA_BYTES = 4


@dataclass(frozen=True, eq=False)
class Decoded:
    """Some channels [H, W, C] of a file's first part: integers as they are stored, or float32.

    `colour` has one channel or three; they and `alpha` count from the first channel of `values`.
    """

    values: np.ndarray
    spec: oiio.ImageSpec
    colour: list[int]
    alpha: int | None


def decode(path: Path, limit_px: int, kept_px: int = 0) -> Decoded:
    """Decode the channels of the first part that `pick_channels` chooses, and those between them.

    Before pixels are decoded their number is checked, and the budget of memory is asked for the channels, a
    linear image, and `kept_px` bytes a pixel that the caller makes of it once the channels are gone.
    """
    require_regular(path, "give an image file")
    if not path.stat().st_size:
        raise InputError(f"{path}: the file is empty; give an image file")
    if is_heif(path):
        values, spec = decode_heif(path, limit_px, _LINEAR_BYTES + max(HEIF_BYTES, kept_px))
        return Decoded(values, spec, *pick_channels(list(spec.channelnames), -1))
    require_whole_png(path)
    return _decode_by_oiio(path, limit_px, kept_px)


def _decode_by_oiio(path: Path, limit_px: int, kept_px: int) -> Decoded:
    settings = oiio.ImageSpec()
    settings.attribute("oiio:UnassociatedAlpha", 1)
    stream = oiio.ImageInput.open(utf8_path(path), settings)
    if stream is None:
        advice = f"save it again as EXR, PNG or JPEG ({_reason(path, oiio_error())})"
        raise InputError(f"{path}: not a readable image; {advice}")
    try:
        spec = stream.spec()
        _check_size(path, spec, limit_px)
        if stream.format_name() == "dpx" and spec.get_int_attribute("Orientation", 1) >= 5:
            raise InputError(f"{path}: a DPX file that lies on its side is not read; save it upright")
        colour, alpha = pick_channels(list(spec.channelnames), spec.alpha_channel)
        alpha = None if is_ultra_hdr(path, spec) else alpha  # the library adds one, which is opaque
        used = colour if alpha is None else [*colour, alpha]
        first, past = min(used), max(used) + 1
        kind = spec.format if spec.format in _INTEGERS else oiio.TypeDesc(oiio.FLOAT)
        _ask_for(path, spec, (past - first) * kind.size(), kept_px)
        values = stream.read_image(0, 0, first, past, kind)
        message = _reason(path, oiio_error(stream))
    finally:
        stream.close()
    if values is None or "premature end" in message.lower():  # a JPEG cut short decodes to grey
        raise InputError(f"{path}: damaged or cut short; copy it again ({message or 'no pixels in it'})")
    if message:
        log.warning("%s: %s", path, message)
    shown = [channel - first for channel in colour]
    values = np.asarray(values).reshape(spec.height, spec.width, past - first)
    return Decoded(values, spec, shown, None if alpha is None else alpha - first)


def _check_size(path: Path, spec: oiio.ImageSpec, limit_px: int) -> None:
    if _pixels(spec) > limit_px:
        raise InputError(
            f"{path}: {spec.width} x {spec.height} pixels; at most {limit_px / 1e6:.0f} megapixels are "
            "read, so make it smaller"
        )


def _pixels(spec: oiio.ImageSpec) -> int:
    return int(max(spec.width * spec.height, spec.full_width * spec.full_height))


def _ask_for(path: Path, spec: oiio.ImageSpec, stored_px: int, kept_px: int) -> None:
    alpha = _ALPHA_BYTES * (spec.alpha_channel >= 0)
    needed = _pixels(spec) * (_LINEAR_BYTES + alpha + max(stored_px, kept_px))
    memory.require(f"{path}: {spec.width} x {spec.height} pixels", needed, "make it smaller")


def _reason(path: Path, message: str) -> str:
    """Shorten OpenImageIO's error message to its first line, without the path."""
    line = (message.strip().splitlines() or [""])[0]
    line = re.sub(r' \("?' + re.escape(str(path)) + r'"?\)', "", line).replace(f'"{path}"', "it")
    return one_line(re.sub(r"\bEXR_ERR_\w+ |: magic 0x.*| Is it a file format .*", "", line))


def pick_channels(names: list[str], alpha_channel: int) -> tuple[list[int], int | None]:
    """Choose the indices of colour (one for grey, otherwise three) and alpha.

    The colour is R, G, B; else the first layer's R, G, B; else the first channels.
    """
    lower = [name.lower() for name in names]
    layers = ["", *(name[: -len("r")] for name in lower if name.endswith(".r"))]
    for layer in layers:
        if all(layer + letter in lower for letter in "rgb"):
            alpha = lower.index(layer + "a") if layer + "a" in lower else None
            return [lower.index(layer + letter) for letter in "rgb"], alpha
    rest = [index for index in range(len(names)) if index != alpha_channel]
    colour = rest[:3] if len(rest) >= 3 else rest[:1] or [0]
    return colour, alpha_channel if alpha_channel >= 0 and alpha_channel not in colour else None


def full_frame(values: np.ndarray, spec: oiio.ImageSpec) -> np.ndarray:
    """Paste an EXR file's data window into its display window; the rest is zero."""
    x, y = spec.x - spec.full_x, spec.y - spec.full_y
    if (x, y, spec.width, spec.height) == (0, 0, spec.full_width, spec.full_height):
        return values
    frame = np.zeros((spec.full_height, spec.full_width, values.shape[2]), values.dtype)
    top, left = max(y, 0), max(x, 0)
    room = slice(max(spec.full_height - top, 0)), slice(max(spec.full_width - left, 0))
    part = values[max(-y, 0) :, max(-x, 0) :][room]
    frame[top : top + part.shape[0], left : left + part.shape[1]] = part
    return frame


def upright(values: np.ndarray, orientation: int) -> np.ndarray:
    """Rotate and mirror an image [H, W, C] to undo EXIF orientation 1..8."""
    if orientation >= 5:
        values = values.swapaxes(0, 1)
    flip_rows, flip_columns = orientation in (3, 4, 7, 8), orientation in (2, 3, 6, 7)
    return values[:: -1 if flip_rows else 1, :: -1 if flip_columns else 1]
