"""Image files: read from any encoding as scene-linear float32 Rec.709; written as EXR, TIFF, PNG or JPEG.

An EXR with layers has several parts: the image, which any program opens, and then a part for each layer, so
that tools which want four channels find four.
"""

import logging
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, Literal

import numpy as np
import OpenImageIO as oiio

from facerf_cli.errors import FacerfError, InputError, UsageError
from facerf_cli.files.atomic import atomic_path
from facerf_cli.files.heif import HEIF_BYTES, decode_heif, is_heif
from facerf_cli.files.icc import linear_profile
from facerf_cli.files.image_metadata import (
    OCIO_SPACE,
    Attributes,
    default_space,
    embed_xmp,
    is_floating,
    is_ultra_hdr,
    metadata_of,
    oiio_error,
    require_whole_png,
    stated_space,
    utf8_path,
)
from facerf_cli.files.texts import require_regular
from facerf_cli.image.colour import (
    ACES,
    ACESCG,
    LINEAR,
    LINEAR_P3,
    LINEAR_REC2020,
    PLAIN_VIEW,
    ColourSpace,
    View,
    auto_exposure_ev,
    encode_display,
    from_linear_rec709,
    named_space,
    to_linear_rec709,
    unit_floats,
)
from facerf_cli.image.strips import Band, rows_of, strips
from facerf_cli.run import memory
from facerf_cli.run.logs import LOGGER_NAME, one_line

log = logging.getLogger(LOGGER_NAME)


_INTEGERS = (oiio.TypeDesc(oiio.UINT8), oiio.TypeDesc(oiio.UINT16))
_LINEAR_BYTES = 12  # of a pixel that is read: three floats, and
_ALPHA_BYTES = 4
PHOTO_LIMIT_PX = 64_000_000
ENVMAP_LIMIT_PX = 134_300_000  # 16k x 8k
HALF_MAX = 65504.0  # the largest finite half float
JPEG_QUALITY = 95
_PNG_LEVEL = 4  # of zlib: half the time of 6 for two hundredths more bytes
_OIIO_NAMES = {
    LINEAR: "lin_rec709_scene",
    LINEAR_REC2020: "lin_rec2020_scene",
    LINEAR_P3: "lin_p3d65_scene",
    ACESCG: "lin_ap1_scene",
    ACES: "lin_ap0_scene",
}
# Channel letters and number format of special layers. Positions and UVs are single precision, since a half
# float has steps of half a millimetre at a metre.
_LAYER_CHANNELS = {
    "normal": ("XYZ", "half"),
    "position": ("XYZ", "float"),
    "depth": ("Z", "float"),
    "uv": ("UV", "float"),
}


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
        if spec.deep:
            raise InputError(f"{path}: a deep image is not read; flatten it, as by oiiotool --flatten")
        if stream.format_name() == "dpx" and spec.get_int_attribute("Orientation", 1) >= 5:
            raise InputError(f"{path}: a DPX file that lies on its side is not read; save it upright")
        colour, alpha = pick_channels(list(spec.channelnames), spec.alpha_channel)
        alpha = None if is_ultra_hdr(path, spec) else alpha  # the library adds one, which is opaque
        used = colour if alpha is None else [*colour, alpha]
        first, past = min(used), max(used) + 1
        kind = spec.format if spec.format in _INTEGERS else oiio.TypeDesc(oiio.FLOAT)
        _require_room(path, spec, limit_px, (past - first) * kind.size(), kept_px)
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


def _require_room(path: Path, spec: oiio.ImageSpec, limit_px: int, stored_px: int, kept_px: int) -> None:
    pixels = max(spec.width * spec.height, spec.full_width * spec.full_height)
    image = f"{path}: {spec.width} x {spec.height} pixels"
    if pixels > limit_px:
        most = f"at most {limit_px / 1e6:.0f} megapixels are read"
        raise InputError(f"{image}; {most}, so make it smaller")
    alpha = _ALPHA_BYTES * (spec.alpha_channel >= 0)
    memory.require(image, pixels * (_LINEAR_BYTES + alpha + max(stored_px, kept_px)), "make it smaller")


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


@dataclass(frozen=True)
class LinearImage:
    """An upright image in scene-linear Rec.709; the colour is not premultiplied by alpha."""

    pixels: np.ndarray  # [H, W, 3] float32
    alpha: np.ndarray | None = None  # [H, W] float32
    colourspace_name: str = LINEAR.name  # the colour space from which the file was decoded
    metadata: dict[str, Any] = field(default_factory=dict)


def read_image(
    path: Path | str,
    colourspace: str | ColourSpace | None = None,
    limit_px: int = PHOTO_LIMIT_PX,
    non_finite: Literal["error", "zero"] = "error",
    kept_px: int = 0,
) -> LinearImage:
    """Read an image of any supported format; `colourspace` overrides the colour space that the file states.

    Before pixels are decoded the size is checked, and the budget of memory asked, for `kept_px` bytes a pixel
    that the caller makes of it, too. NaN and infinite values raise an InputError, or are set to 0 with a
    warning if `non_finite` is "zero".
    """
    path = Path(path)
    found = decode(path, limit_px, kept_px)
    spec = found.spec
    values = upright(full_frame(found.values, spec), spec.get_int_attribute("Orientation", 1))
    space = _space(path, colourspace, spec)
    if colourspace and space.decode is not None and is_floating(spec):
        log.warning("%s: floating-point values decoded by the curve of %s", path, space.name)
    premultiplied = not spec.get_int_attribute("oiio:UnassociatedAlpha", 0)
    pixels = np.empty((*values.shape[:2], 3), np.float32)
    alpha = None if found.alpha is None else np.empty(values.shape[:2], np.float32)
    bad = 0
    for rows in strips(values.shape):
        colour = np.broadcast_to(values[rows][..., found.colour], pixels[rows].shape)
        opaque = None if found.alpha is None else unit_floats(values[rows][..., found.alpha])
        colour, opaque, wrong = _finite(colour, opaque)
        bad += wrong
        if alpha is not None and opaque is not None:
            alpha[rows] = opaque.clip(0, 1)
            if premultiplied:
                colour = unit_floats(colour) / np.where(alpha[rows] > 0, alpha[rows], 1)[..., None]
        pixels[rows] = to_linear_rec709(colour, space)
    if bad:
        _say_non_finite(path, bad, pixels.shape[0] * pixels.shape[1], non_finite)
    return LinearImage(pixels, alpha, space.name, metadata_of(spec))


def _space(path: Path, colourspace: str | ColourSpace | None, spec: oiio.ImageSpec) -> ColourSpace:
    """Return the space in which the caller wants a file read, or that the file states."""
    if colourspace:
        return named_space(colourspace) if isinstance(colourspace, str) else colourspace
    found, default = stated_space(path, spec), default_space(spec)
    if found is None and is_floating(spec):
        log.info("%s: does not say its colour space; read as %s", path, default.name)
    return found or default


def _finite(colour: np.ndarray, alpha: np.ndarray | None) -> tuple[np.ndarray, np.ndarray | None, int]:
    """Colour [h, W, 3] and alpha [h, W] with 0 for what is not finite, and the number of such pixels."""
    bad = ~np.isfinite(colour)
    bad_alpha = np.zeros(bad.shape[:2], bool) if alpha is None else ~np.isfinite(alpha)
    pixels = int((bad.any(-1) | bad_alpha).sum())
    if not pixels:
        return colour, alpha, 0
    alpha = None if alpha is None else np.where(bad_alpha, np.float32(0), alpha)
    return np.where(bad, np.float32(0), colour), alpha, pixels


def _say_non_finite(path: Path, count: int, total: int, non_finite: str) -> None:
    """Apply the policy `non_finite` of `read_image`."""
    if non_finite == "error":
        raise InputError(f"{path}: {count} of {total} pixels are NaN or infinite; replace them first")
    log.warning("%s: %d pixels are NaN or infinite; their values are set to 0", path, count)


def write_exr(
    path: Path,
    pixels: np.ndarray,
    alpha: np.ndarray | None = None,
    layers: Mapping[str, np.ndarray] | None = None,
    metadata: Attributes | None = None,
    space: ColourSpace = LINEAR,
    compression: str = "zip",
) -> int:
    """Write linear Rec.709 [H, W, 3] in half floats in a colour space; return how many were out of range.

    The colour must not be premultiplied; it is written multiplied by alpha [H, W], as EXR requires. `layers`
    are [H, W] or [H, W, C]: normal.X/Y/Z in half, position.X/Y/Z, depth.Z and uv.U/V in float, others as R,
    G, B in half. Each name before the dot is a part. Values beyond the range of half floats (65504) are
    clamped with a warning.
    """
    parts, specs = [_exr_image(pixels, alpha, space), *_exr_layers(layers or {}, space)], []
    for part in parts:
        spec = _spec((*pixels.shape[:2], len(part.channels)), part.kind)
        spec.channelnames = tuple(part.channels)
        spec.alpha_channel = part.alpha_channel
        if len(parts) > 1:
            spec.attribute("name", part.name)
        spec.attribute("compression", compression)
        spec.attribute("oiio:ColorSpace", _OIIO_NAMES.get(space, space.name))
        if space.chromaticities is None:  # its name may be unknown to OpenImageIO, which then leaves it out
            spec.attribute(OCIO_SPACE, space.name)
        else:  # the same in all parts, as OpenEXR requires
            spec.attribute("chromaticities", oiio.TypeDesc("float[8]"), space.chromaticities)
        specs.append(spec)
    beyond: list[int] = []

    def band(part: _ExrPart, rows: slice) -> np.ndarray:
        values = np.dstack([of(rows) for of in part.of])
        if part.kind == "float" and np.isfinite(values).all():
            return values.astype(np.float32, copy=False)
        data, count = half_floats(path, values)
        beyond.append(count)
        return data

    write_parts(path, specs, [partial(band, part) for part in parts], metadata)
    warn_of_clamped(path, sum(beyond))
    return sum(beyond)


@dataclass(frozen=True, eq=False)
class _ExrPart:
    """A part of an EXR: its channels by name, all of one number format.

    `of` are images [H, W] or [H, W, C] of its rows, which together have a value for each channel.
    """

    name: str
    kind: str
    channels: list[str]
    of: list[Band]
    alpha_channel: int = -1


def _exr_image(pixels: np.ndarray, alpha: np.ndarray | None, space: ColourSpace) -> _ExrPart:
    """Return the image itself, R, G, B and A, premultiplied."""
    if alpha is None:
        return _ExrPart("rgba", "half", list("RGB"), [_in_space(pixels, space)])

    straight = _in_space(pixels, space)

    def colour(rows: slice) -> np.ndarray:
        return straight(rows) * rows_of(alpha, rows)[..., None]

    return _ExrPart("rgba", "half", list("RGBA"), [colour, _in_space(alpha, None)], alpha_channel=3)


def _exr_layers(layers: Mapping[str, np.ndarray], space: ColourSpace) -> Iterator[_ExrPart]:
    """Yield a part for the layers of each name before the dot; colours are converted to the space."""
    grouped: dict[str, _ExrPart] = {}
    for layer, values in layers.items():
        letters, kind = _LAYER_CHANNELS.get(layer, ("RGB", "half"))
        name = layer.split(".")[0]
        group = grouped.setdefault(name, _ExrPart(name, kind, [], []))
        single = len(values.shape) == 2
        group.channels.extend([layer] if single else [f"{layer}.{x}" for x in letters[: values.shape[-1]]])
        group.of.append(_in_space(values, None if single or letters != "RGB" else space))
    yield from grouped.values()


def _in_space(values: np.ndarray, space: ColourSpace | None) -> Band:
    """Rows of colours in a space, or as they are."""
    if space is None:
        return lambda rows: rows_of(values, rows)
    return lambda rows: from_linear_rec709(rows_of(values, rows).astype(np.float32, copy=False), space)


def half_floats(path: Path, values: np.ndarray) -> tuple[np.ndarray, int]:
    """Return finite values as half floats, and how many were beyond their range."""
    with np.errstate(over="ignore"):
        data = values.astype(np.float16, copy=False)
    if np.isfinite(data).all():
        return data, 0
    _require_finite(path, values)
    return values.clip(-HALF_MAX, HALF_MAX).astype(np.float16), int(np.sum(np.abs(values) > HALF_MAX))


def warn_of_clamped(path: Path, count: int) -> None:
    """Say that values were beyond the range of half floats, if some were."""
    if count:
        log.warning("%s: %d values beyond the range of half floats are set to %g", path, count, HALF_MAX)


def _require_finite(path: Path, values: np.ndarray) -> None:
    if bad := values.size - int(np.isfinite(values).sum()):
        raise InputError(f"{path}: not written: {bad} values are NaN or infinite; check its input")


def write_tiff(
    path: Path,
    pixels: np.ndarray,
    alpha: np.ndarray | None = None,
    metadata: Attributes | None = None,
    space: ColourSpace = LINEAR,
) -> None:
    """Write linear Rec.709 [H, W, 3] as a 32-bit TIFF in a colour space, with the profile of a linear one.

    The colour must not be premultiplied, and is not in the file.
    """

    def values(rows: slice) -> np.ndarray:
        colour = from_linear_rec709(rows_of(pixels, rows), space)
        _require_finite(path, colour)
        return np.dstack([colour] if alpha is None else [colour, rows_of(alpha, rows)]).astype(
            np.float32, copy=False
        )

    spec = _spec((*pixels.shape[:2], 3 if alpha is None else 4), "float")
    spec.attribute("compression", "zip")
    spec.attribute("oiio:UnassociatedAlpha", 1)
    if space.is_linear:
        profile = np.frombuffer(linear_profile(space), np.uint8)
        spec.attribute("ICCProfile", oiio.TypeDesc(f"uint8[{len(profile)}]"), profile)
    write_parts(path, [spec], [values], metadata)


def write_display(
    path: Path,
    pixels: np.ndarray,
    exposure: float | Literal["auto"] = 0.0,
    alpha: np.ndarray | None = None,
    metadata: Attributes | None = None,
    view: View = PLAIN_VIEW,
    share: np.ndarray | None = None,
    bits: Literal[8, 16] = 8,
) -> float:
    """Write linear Rec.709 [H, W, 3] as a PNG or JPEG, by the suffix; return the exposure in EV.

    "auto" is `colour.auto_exposure_ev` where alpha [H, W] exceeds one half. PNG keeps alpha, with colour that
    is not premultiplied; JPEG has no alpha and shows the image over black. `view` and `share` are those of
    `colour.encode_display`; `bits` are of a PNG.
    """
    chosen_ev = auto_exposure_ev(pixels, alpha) if exposure == "auto" else float(exposure)
    jpeg = path.suffix.lower() in (".jpg", ".jpeg")

    def values(rows: slice) -> np.ndarray:
        seen, opaque = rows_of(pixels, rows), None if alpha is None else rows_of(alpha, rows)
        _require_finite(path, seen)
        if opaque is not None and jpeg:
            seen = seen * opaque[..., None]
        exposed = np.nan_to_num(seen * np.float32(2.0**chosen_ev))
        data = encode_display(exposed, view, None if share is None else rows_of(share, rows))
        return data if opaque is None or jpeg else np.dstack([data, opaque.astype(np.float32)])

    spec = _spec((*pixels.shape[:2], 3 if alpha is None or jpeg else 4), f"uint{8 if jpeg else bits}")
    spec.attribute("oiio:UnassociatedAlpha", 1)
    if view.is_srgb:
        spec.attribute("oiio:ColorSpace", "sRGB")
    spec.attribute("CompressionQuality", JPEG_QUALITY)
    spec.attribute("jpeg:subsampling", "4:4:4")
    spec.attribute("png:compressionLevel", _PNG_LEVEL)
    write_parts(path, [spec], [values], {"facerf:exposure_ev": chosen_ev, **(metadata or {})})
    return chosen_ev


def _spec(shape: tuple[int, ...], kind: str) -> oiio.ImageSpec:
    spec = oiio.ImageSpec(shape[1], shape[0], shape[2], kind)
    spec.attribute("DateTime", "")  # else OpenImageIO writes the time, and two runs give different bytes
    return spec


def write_parts(
    path: Path, specs: Sequence[oiio.ImageSpec], bands: Iterable[Band], metadata: Attributes | None = None
) -> None:
    """Write the parts of an image atomically, with its metadata in the first one's header and as XMP.

    A band gives rows [h, W, C] of its part; they are written in strips as they come.
    """
    for name, value in (metadata or {}).items():
        specs[0].attribute(name, value)
    with atomic_path(path) as temporary:
        stream = oiio.ImageOutput.create(utf8_path(temporary))
        if stream is None:
            oiio_error()
            raise UsageError(f"{path}: not the suffix of an image format; use .exr, .png or .jpg")
        name = str(temporary)
        good = stream.open(name, tuple(specs)) if len(specs) > 1 else stream.open(name, specs[0])
        for number, (band, spec) in enumerate(zip(bands, specs, strict=True)):
            good = good and (number == 0 or stream.open(name, spec, "AppendSubimage"))
            for rows in strips((spec.height, spec.width)) if good else ():
                good = good and stream.write_scanlines(
                    rows.start, rows.stop, 0, np.ascontiguousarray(band(rows))
                )
        message = oiio_error(stream)
        if not (stream.close() and good):
            raise FacerfError(f"{path}: cannot write: {one_line(message or oiio_error(stream))}")
        embed_xmp(temporary, metadata or {})
