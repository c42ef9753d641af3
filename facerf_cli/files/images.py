"""Image files: read from any encoding as scene-linear float32 Rec.709; written as EXR, PNG or JPEG."""

import logging
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np
import OpenImageIO as oiio

from facerf_cli.colour import (
    LINEAR,
    REC709_CHROMATICITIES,
    auto_exposure_ev,
    in_blocks,
    linear_to_srgb,
    named_space,
    to_linear_rec709,
)
from facerf_cli.errors import FacerfError, InputError, UsageError
from facerf_cli.files.atomic import atomic_path
from facerf_cli.files.image_metadata import (
    Attributes,
    embed_xmp,
    is_floating,
    metadata_of,
    require_whole_png,
    space_of_file,
    utf8_path,
)
from facerf_cli.logs import LOGGER_NAME, one_line

PHOTO_LIMIT_PX = 64_000_000
ENVMAP_LIMIT_PX = 134_300_000  # 16k x 8k
HALF_MAX = 65504.0  # the largest finite half float
JPEG_QUALITY = 95
# Channel letters and number format of special layers. Positions and UVs are single precision, since a half
# float has steps of half a millimetre at a metre.
_LAYER_CHANNELS = {
    "normal": ("XYZ", "half"),
    "position": ("XYZ", "float"),
    "depth": ("Z", "float"),
    "uv": ("UV", "float"),
}

log = logging.getLogger(LOGGER_NAME)


@dataclass(frozen=True)
class LinearImage:
    """An upright image in scene-linear Rec.709; the colour is not premultiplied by alpha."""

    pixels: np.ndarray  # [H, W, 3] float32
    alpha: np.ndarray | None = None  # [H, W] float32
    colourspace_name: str = LINEAR.name  # the colour space from which the file was decoded
    metadata: dict[str, Any] = field(default_factory=dict)


def read_image(
    path: Path | str,
    colourspace: str | None = None,
    limit_px: int = PHOTO_LIMIT_PX,
    non_finite: Literal["error", "zero"] = "error",
) -> LinearImage:
    """Read an image of any supported format; `colourspace` overrides the colour space that the file states.

    The size is checked before pixels are decoded. NaN and infinite values raise an InputError, or are set to
    0 with a warning if `non_finite` is "zero".
    """
    path = Path(path)
    values, spec = _decode(path, limit_px)
    colour_at, alpha_at = _pick_channels(list(spec.channelnames), spec.alpha_channel)
    values = values[..., colour_at if alpha_at is None else [*colour_at, alpha_at]]
    values = _upright(_full_frame(values, spec), spec.get_int_attribute("Orientation", 1))
    values = _finite(path, values, non_finite)
    alpha = None if alpha_at is None else np.clip(values[..., -1], 0, 1)
    colour = np.broadcast_to(values[..., : len(colour_at)], (*values.shape[:2], 3))
    if alpha is not None and not spec.get_int_attribute("oiio:UnassociatedAlpha", 0):
        colour = colour / np.where(alpha > 0, alpha, 1)[..., None]
    space = named_space(colourspace) if colourspace else space_of_file(path, spec)
    if colourspace and space.decode is not None and is_floating(spec):
        log.warning("%s: floating-point values decoded by the curve of %s", path, space.name)
    pixels = np.ascontiguousarray(to_linear_rec709(np.ascontiguousarray(colour), space))
    return LinearImage(pixels, alpha, space.name, metadata_of(spec))


def _decode(path: Path, limit_px: int) -> tuple[np.ndarray, oiio.ImageSpec]:
    """Decode all channels [H, W, C] of the first part as float32; integers are scaled to 0..1."""
    if path.is_dir():
        raise InputError(f"{path}: is a folder, not an image; give an image file")
    if not path.is_file() or not path.stat().st_size:
        raise InputError(f"{path}: {'the file is empty' if path.is_file() else 'no such file'}")
    require_whole_png(path)
    settings = oiio.ImageSpec()
    settings.attribute("oiio:UnassociatedAlpha", 1)
    stream = oiio.ImageInput.open(utf8_path(path), settings)
    if stream is None:
        advice = f"save it again as EXR, PNG or JPEG ({_reason(path, oiio.geterror())})"
        raise InputError(f"{path}: not a readable image; {advice}")
    try:
        spec = stream.spec()
        size_px = max(spec.width * spec.height, spec.full_width * spec.full_height)
        if size_px > limit_px:
            raise InputError(
                f"{path}: {spec.width} x {spec.height} pixels; at most {limit_px / 1e6:.0f} megapixels are "
                "read, so make it smaller"
            )
        values = stream.read_image(0, 0, 0, spec.nchannels, oiio.FLOAT)
        message = _reason(path, stream.geterror())
    finally:
        stream.close()
    if values is None or "premature end" in message.lower():  # a JPEG cut short decodes to grey
        raise InputError(f"{path}: damaged or cut short; copy it again ({message or 'no pixels in it'})")
    if message:
        log.warning("%s: %s", path, message)
    return np.asarray(values, np.float32).reshape(spec.height, spec.width, spec.nchannels), spec


def _reason(path: Path, message: str) -> str:
    """Shorten OpenImageIO's error message to its first line, without the path."""
    line = (message.strip().splitlines() or [""])[0]
    line = re.sub(r' \("?' + re.escape(str(path)) + r'"?\)', "", line).replace(f'"{path}"', "it")
    return one_line(re.sub(r"\bEXR_ERR_\w+ |: magic 0x.*| Is it a file format .*", "", line))


def _pick_channels(names: list[str], alpha_channel: int) -> tuple[list[int], int | None]:
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


def _full_frame(values: np.ndarray, spec: oiio.ImageSpec) -> np.ndarray:
    """Paste an EXR file's data window into its display window; the rest is zero."""
    x, y = spec.x - spec.full_x, spec.y - spec.full_y
    if (x, y, spec.width, spec.height) == (0, 0, spec.full_width, spec.full_height):
        return values
    frame = np.zeros((spec.full_height, spec.full_width, values.shape[2]), np.float32)
    top, left = max(y, 0), max(x, 0)
    room = slice(max(spec.full_height - top, 0)), slice(max(spec.full_width - left, 0))
    part = values[max(-y, 0) :, max(-x, 0) :][room]
    frame[top : top + part.shape[0], left : left + part.shape[1]] = part
    return frame


def _upright(values: np.ndarray, orientation: int) -> np.ndarray:
    """Rotate and mirror an image [H, W, C] to undo EXIF orientation 1..8."""
    if orientation >= 5:
        values = values.swapaxes(0, 1)
    flip_rows, flip_columns = orientation in (3, 4, 7, 8), orientation in (2, 3, 6, 7)
    return values[:: -1 if flip_rows else 1, :: -1 if flip_columns else 1]


def _finite(path: Path, values: np.ndarray, non_finite: str) -> np.ndarray:
    """Apply the policy `non_finite` of `read_image`."""
    bad = ~np.isfinite(values)
    if not bad.any():
        return values
    count = int(bad.any(-1).sum())
    if non_finite == "error":
        total = bad.shape[0] * bad.shape[1]
        raise InputError(f"{path}: {count} of {total} pixels are NaN or infinite; replace them first")
    log.warning("%s: %d pixels are NaN or infinite; their values are set to 0", path, count)
    return np.where(bad, np.float32(0), values)


def write_exr(
    path: Path,
    pixels: np.ndarray,
    alpha: np.ndarray | None = None,
    layers: Mapping[str, np.ndarray] | None = None,
    metadata: Attributes | None = None,
) -> int:
    """Write scene-linear Rec.709 [H, W, 3] as half floats; return how many values were out of range.

    The colour must not be premultiplied; it is written multiplied by alpha [H, W], as EXR requires. `layers`
    are [H, W] or [H, W, C]: normal.X/Y/Z in half, position.X/Y/Z, depth.Z and uv.U/V in float, others as R,
    G, B in half. Values beyond the range of half floats (65504) are clamped with a warning.
    """
    channels = list(_exr_channels(pixels, alpha, layers or {}))
    names, kinds, _ = zip(*channels, strict=True)
    data = np.empty((*pixels.shape[:2], len(channels)), np.float32)
    bad = count = 0
    for index, (_, kind, values) in enumerate(channels):  # one at a time saves memory
        bad += int(np.sum(~np.isfinite(values)))
        count += int(np.sum(np.abs(values) > HALF_MAX)) if kind == "half" else 0
        data[..., index] = values.clip(-HALF_MAX, HALF_MAX) if kind == "half" else values
    if bad:
        raise ValueError(f"{path}: {bad} values are NaN or infinite")
    if count:
        log.warning("%s: %d values beyond the range of half floats are set to %g", path, count, HALF_MAX)
    spec = oiio.ImageSpec(data.shape[1], data.shape[0], data.shape[2], "half")
    spec.channelnames = names
    spec.channelformats = tuple(oiio.TypeDesc(kind) for kind in kinds)
    spec.alpha_channel = names.index("A") if "A" in names else -1
    spec.attribute("compression", "zip")
    spec.attribute("oiio:ColorSpace", "lin_rec709_scene")
    spec.attribute("DateTime", "")  # else OpenImageIO writes the time, and two runs give different bytes
    spec.attribute("chromaticities", oiio.TypeDesc("float[8]"), REC709_CHROMATICITIES)
    _write(path, spec, data, metadata)
    return count


def _exr_channels(
    pixels: np.ndarray, alpha: np.ndarray | None, layers: Mapping[str, np.ndarray]
) -> Iterator[tuple[str, str, np.ndarray]]:
    """Yield the name, number format and values [H, W] of each channel."""
    for index, letter in enumerate("RGB"):
        yield letter, "half", pixels[..., index] if alpha is None else pixels[..., index] * alpha
    if alpha is not None:
        yield "A", "half", alpha
    for layer, values in layers.items():
        letters, kind = _LAYER_CHANNELS.get(layer, ("RGB", "half"))
        if values.ndim == 2:
            yield layer, kind, values
        else:
            yield from (
                (f"{layer}.{letters[index]}", kind, values[..., index]) for index in range(values.shape[2])
            )


def write_display(
    path: Path,
    pixels: np.ndarray,
    exposure: float | Literal["auto"] = 0.0,
    alpha: np.ndarray | None = None,
    metadata: Attributes | None = None,
) -> float:
    """Write linear Rec.709 [H, W, 3] as an 8-bit sRGB PNG or JPEG, by the suffix; return the exposure in EV.

    "auto" is `colour.auto_exposure_ev` where alpha [H, W] exceeds one half. PNG keeps alpha, with colour that
    is not premultiplied; JPEG has no alpha and shows the image over black.
    """
    chosen_ev = auto_exposure_ev(pixels, alpha) if exposure == "auto" else float(exposure)
    jpeg = path.suffix.lower() in (".jpg", ".jpeg")
    linear = pixels * alpha[..., None] if alpha is not None and jpeg else pixels
    gain = np.float32(2.0**chosen_ev)
    data = in_blocks(lambda block: linear_to_srgb(np.clip(np.nan_to_num(block) * gain, 0, 1)), linear)
    if alpha is not None and not jpeg:
        data = np.concatenate([data, alpha[..., None].astype(np.float32)], -1)
    spec = oiio.ImageSpec(data.shape[1], data.shape[0], data.shape[2], "uint8")
    spec.attribute("oiio:UnassociatedAlpha", 1)
    spec.attribute("oiio:ColorSpace", "sRGB")
    spec.attribute("CompressionQuality", JPEG_QUALITY)
    spec.attribute("jpeg:subsampling", "4:4:4")
    _write(path, spec, data, {"facerf:exposure_ev": chosen_ev, **(metadata or {})})
    return chosen_ev


def _write(path: Path, spec: oiio.ImageSpec, data: np.ndarray, metadata: Attributes | None) -> None:
    """Write an image atomically, with its metadata in the header and as XMP."""
    for name, value in (metadata or {}).items():
        spec.attribute(name, value)
    with atomic_path(path) as temporary:
        stream = oiio.ImageOutput.create(utf8_path(temporary))
        if stream is None:
            oiio.geterror()  # otherwise OpenImageIO prints the pending error at exit
            raise UsageError(f"{path}: not the suffix of an image format; use .exr, .png or .jpg")
        written = stream.open(str(temporary), spec) and stream.write_image(np.ascontiguousarray(data))
        message = stream.geterror()
        if not (stream.close() and written):
            raise FacerfError(f"{path}: cannot write: {one_line(message or stream.geterror())}")
        embed_xmp(temporary, metadata or {})
