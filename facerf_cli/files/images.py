"""Image files: read from any encoding as scene-linear float32 Rec.709; written as EXR, TIFF, PNG or JPEG.

An EXR with layers has several parts: the image, which any program opens, and then a part for each layer, so
that tools which want four channels find four.
"""

import logging
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np
import OpenImageIO as oiio

from facerf_cli.colour import (
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
)
from facerf_cli.errors import FacerfError, InputError, UsageError
from facerf_cli.files.atomic import atomic_path
from facerf_cli.files.decoding import decode, full_frame, pick_channels, upright
from facerf_cli.files.icc import linear_profile
from facerf_cli.files.image_metadata import (
    OCIO_SPACE,
    Attributes,
    embed_xmp,
    is_floating,
    metadata_of,
    oiio_error,
    space_of_file,
    states_space,
    utf8_path,
)
from facerf_cli.logs import LOGGER_NAME, one_line

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
    colourspace: str | ColourSpace | None = None,
    limit_px: int = PHOTO_LIMIT_PX,
    non_finite: Literal["error", "zero"] = "error",
) -> LinearImage:
    """Read an image of any supported format; `colourspace` overrides the colour space that the file states.

    The size is checked before pixels are decoded. NaN and infinite values raise an InputError, or are set to
    0 with a warning if `non_finite` is "zero".
    """
    path = Path(path)
    values, spec = decode(path, limit_px)
    colour_at, alpha_at = pick_channels(list(spec.channelnames), spec.alpha_channel)
    values = values[..., colour_at if alpha_at is None else [*colour_at, alpha_at]]
    values = upright(full_frame(values, spec), spec.get_int_attribute("Orientation", 1))
    values = _finite(path, values, non_finite)
    alpha = None if alpha_at is None else np.clip(values[..., -1], 0, 1)
    colour = np.broadcast_to(values[..., : len(colour_at)], (*values.shape[:2], 3))
    if alpha is not None and not spec.get_int_attribute("oiio:UnassociatedAlpha", 0):
        colour = colour / np.where(alpha > 0, alpha, 1)[..., None]
    space = _space(path, colourspace, spec)
    if colourspace and space.decode is not None and is_floating(spec):
        log.warning("%s: floating-point values decoded by the curve of %s", path, space.name)
    pixels = np.ascontiguousarray(to_linear_rec709(np.ascontiguousarray(colour), space))
    return LinearImage(pixels, alpha, space.name, metadata_of(spec))


def _space(path: Path, colourspace: str | ColourSpace | None, spec: oiio.ImageSpec) -> ColourSpace:
    """Return the space in which the caller wants a file read, or that the file states."""
    if colourspace:
        return named_space(colourspace) if isinstance(colourspace, str) else colourspace
    found = space_of_file(path, spec)
    if is_floating(spec) and not states_space(spec):
        log.info("%s: does not say its colour space; read as %s", path, found.name)
    return found


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
    space: ColourSpace = LINEAR,
    compression: str = "zip",
) -> int:
    """Write linear Rec.709 [H, W, 3] in half floats in a colour space; return how many were out of range.

    The colour must not be premultiplied; it is written multiplied by alpha [H, W], as EXR requires. `layers`
    are [H, W] or [H, W, C]: normal.X/Y/Z in half, position.X/Y/Z, depth.Z and uv.U/V in float, others as R,
    G, B in half. Each name before the dot is a part. Values beyond the range of half floats (65504) are
    clamped with a warning.
    """
    converted = from_linear_rec709(pixels, space)
    parts = [_exr_image(converted, alpha), *_exr_layers(layers or {}, space)]
    specs, arrays, count = [], [], 0
    for part in parts:
        data, beyond = _exr_data(path, part)
        count += beyond
        spec = _spec(data, part.kind)
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
        arrays.append(data)
    if count:
        log.warning("%s: %d values beyond the range of half floats are set to %g", path, count, HALF_MAX)
    _write(path, specs, arrays, metadata)
    return count


@dataclass(frozen=True, eq=False)
class _ExrPart:
    """A part of an EXR: its channels [H, W] by name, all of one number format."""

    name: str
    kind: str
    channels: dict[str, np.ndarray]
    alpha_channel: int = -1


def _exr_image(pixels: np.ndarray, alpha: np.ndarray | None) -> _ExrPart:
    """Return the image itself, R, G, B and A, premultiplied."""
    colour = pixels if alpha is None else pixels * alpha[..., None]
    channels = {letter: colour[..., index] for index, letter in enumerate("RGB")}
    if alpha is None:
        return _ExrPart("rgba", "half", channels)
    return _ExrPart("rgba", "half", {**channels, "A": alpha}, alpha_channel=3)


def _exr_layers(layers: Mapping[str, np.ndarray], space: ColourSpace) -> Iterator[_ExrPart]:
    """Yield a part for the layers of each name before the dot; colours are converted to the space."""
    grouped: dict[str, _ExrPart] = {}
    for layer, values in layers.items():
        letters, kind = _LAYER_CHANNELS.get(layer, ("RGB", "half"))
        group = grouped.setdefault(layer.split(".")[0], _ExrPart(layer.split(".")[0], kind, {}))
        if values.ndim == 2:
            group.channels[layer] = values
            continue
        shown = from_linear_rec709(values, space) if letters == "RGB" else values
        group.channels.update({f"{layer}.{letters[k]}": shown[..., k] for k in range(values.shape[2])})
    yield from grouped.values()


def _exr_data(path: Path, part: _ExrPart) -> tuple[np.ndarray, int]:
    """Return a part's values [H, W, C], and how many were beyond the range of half floats."""
    values = np.stack(list(part.channels.values()), -1)
    with np.errstate(over="ignore"):
        data = values.astype(np.float16 if part.kind == "half" else np.float32, copy=False)
    if np.isfinite(data).all():
        return data, 0
    if bad := int(np.sum(~np.isfinite(values))):
        raise ValueError(f"{path}: {bad} values are NaN or infinite")
    return values.clip(-HALF_MAX, HALF_MAX).astype(np.float16), int(np.sum(np.abs(values) > HALF_MAX))


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
    colour = from_linear_rec709(pixels, space).astype(np.float32, copy=False)
    data = colour if alpha is None else np.dstack([colour, alpha.astype(np.float32)])
    spec = _spec(data, "float")
    spec.attribute("compression", "zip")
    spec.attribute("oiio:UnassociatedAlpha", 1)
    if space.is_linear:
        profile = np.frombuffer(linear_profile(space), np.uint8)
        spec.attribute("ICCProfile", oiio.TypeDesc(f"uint8[{len(profile)}]"), profile)
    _write(path, [spec], [data], metadata)


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
    seen = pixels * alpha[..., None] if alpha is not None and jpeg else pixels
    data = encode_display(np.nan_to_num(seen * np.float32(2.0**chosen_ev)), view, share)
    if alpha is not None and not jpeg:
        data = np.dstack([data, alpha.astype(np.float32)])
    spec = _spec(data, f"uint{8 if jpeg else bits}")
    spec.attribute("oiio:UnassociatedAlpha", 1)
    if view.is_srgb:
        spec.attribute("oiio:ColorSpace", "sRGB")
    spec.attribute("CompressionQuality", JPEG_QUALITY)
    spec.attribute("jpeg:subsampling", "4:4:4")
    spec.attribute("png:compressionLevel", _PNG_LEVEL)
    _write(path, [spec], [data], {"facerf:exposure_ev": chosen_ev, **(metadata or {})})
    return chosen_ev


def _spec(data: np.ndarray, kind: str) -> oiio.ImageSpec:
    spec = oiio.ImageSpec(data.shape[1], data.shape[0], data.shape[2], kind)
    spec.attribute("DateTime", "")  # else OpenImageIO writes the time, and two runs give different bytes
    return spec


def _write(
    path: Path, specs: Sequence[oiio.ImageSpec], parts: Sequence[np.ndarray], metadata: Attributes | None
) -> None:
    """Write the parts of an image atomically, with its metadata in the first one's header and as XMP."""
    for name, value in (metadata or {}).items():
        specs[0].attribute(name, value)
    with atomic_path(path) as temporary:
        stream = oiio.ImageOutput.create(utf8_path(temporary))
        if stream is None:
            oiio_error()
            raise UsageError(f"{path}: not the suffix of an image format; use .exr, .png or .jpg")
        name = str(temporary)
        good = stream.open(name, tuple(specs)) if len(specs) > 1 else stream.open(name, specs[0])
        for number, (spec, part) in enumerate(zip(specs, parts, strict=True)):
            good = good and (number == 0 or stream.open(name, spec, "AppendSubimage"))
            good = good and stream.write_image(np.ascontiguousarray(part))
        message = oiio_error(stream)
        if not (stream.close() and good):
            raise FacerfError(f"{path}: cannot write: {one_line(message or oiio_error(stream))}")
        embed_xmp(temporary, metadata or {})
