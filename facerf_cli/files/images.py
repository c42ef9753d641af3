"""Image files: read from any encoding as scene-linear float32 Rec.709; written as EXR, TIFF, PNG or JPEG.

An EXR with layers has several parts: the image, which any program opens, and then a part for each layer, so
that tools which want four channels find four.
"""

import logging
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, Literal

import numpy as np
import OpenImageIO as oiio
import torch

from facerf_cli.errors import FacerfError, InputError, UsageError
from facerf_cli.files.atomic import atomic_path
from facerf_cli.files.decoding import decode, full_frame, upright
from facerf_cli.files.icc import linear_profile
from facerf_cli.files.image_metadata import Attributes, embed_xmp, metadata_of, set_attribute
from facerf_cli.files.image_parts import is_floating, oiio_error, shown_size, utf8_path
from facerf_cli.files.stated_space import OCIO_SPACE, default_space, stated_space
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
from facerf_cli.image.strips import Band, resized, rows_of, strips
from facerf_cli.run.logs import LOGGER_NAME, one_line

log = logging.getLogger(LOGGER_NAME)


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
    layer: str | None = None,
    with_alpha: bool = True,
) -> LinearImage:
    """Read an image of any supported format; `colourspace` overrides the colour space that the file states.

    `layer` names one of an EXR. Without alpha the colour is as it is stored: of a map it is light, and covers
    nothing.

    Before pixels are decoded the size is checked, and the budget of memory asked, for `kept_px` bytes a pixel
    that the caller makes of it, too. NaN and infinite values raise an InputError, or are set to 0 with a
    warning if `non_finite` is "zero".
    """
    path = Path(path)
    found = decode(path, limit_px, kept_px, layer, with_alpha)
    spec = found.spec
    values = upright(full_frame(found.values, spec), spec.get_int_attribute("Orientation", 1))
    space = _space(path, colourspace, spec)
    if colourspace and space.decode is not None and is_floating(spec):
        log.warning("%s: floating-point values decoded by the curve of %s", path, space.name)
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
            if found.is_associated:
                # rounding exceeds 1 where alpha is small
                most = np.inf if values.dtype.kind == "f" else 1.0
                colour = unit_floats(colour) / np.where(alpha[rows] > 0, alpha[rows], 1)[..., None]
                colour = colour.clip(None, most)
        pixels[rows] = to_linear_rec709(colour, space)
    if bad:
        _say_non_finite(path, bad, pixels.shape[0] * pixels.shape[1], non_finite)
    if (size := shown_size(spec)) != pixels.shape[:2]:
        log.info("%s: its pixels are not square; read at %d x %d", path, size[1], size[0])
        pixels = resized(pixels, *size)
        alpha = None if alpha is None else resized(alpha, *size)
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
    single: bool = False,
) -> int:
    """Write linear Rec.709 [H, W, 3] in half floats in a colour space; return how many were out of range.

    The colour must not be premultiplied; it is written multiplied by alpha [H, W], as EXR requires. `layers`
    are [H, W] or [H, W, C]: normal.X/Y/Z in half, position.X/Y/Z, depth.Z and uv.U/V in float, others as R,
    G, B in half. Each name before the dot is a part, or with `single` all are channels of one. Values beyond
    the range of half floats (65504) are clamped with a warning.
    """
    parts, specs = [_exr_image(pixels, alpha, space), *_exr_layers(layers or {}, space)], []
    for part in parts:
        spec = _spec((*pixels.shape[:2], len(part.channels)), part.kind)
        spec.channelnames = tuple(part.channels)
        spec.alpha_channel = part.alpha_channel
        if len(parts) > 1:
            spec.attribute("name", part.name)
        spec.attribute("compression", compression)
        spec.attribute("oiio:ColorSpace", "data" if part.is_data else _OIIO_NAMES.get(space, space.name))
        if space.chromaticities is None:  # its name may be unknown to OpenImageIO, which then leaves it out
            if not part.is_data:
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

    bands: list[Band] = [partial(band, part) for part in parts]
    if single:
        specs, bands = [_one_spec(specs)], [_one_band(bands)]
    write_parts(path, specs, bands, metadata)
    warn_of_clamped(path, sum(beyond))
    return sum(beyond)


def _one_spec(specs: Sequence[oiio.ImageSpec]) -> oiio.ImageSpec:
    """The specification of one part with the channels of all, each in its own number format."""
    one = oiio.ImageSpec(specs[0])
    one.nchannels = sum(spec.nchannels for spec in specs)
    one.channelnames = tuple(name for spec in specs for name in spec.channelnames)
    one.channelformats = tuple(spec.format for spec in specs for _ in range(spec.nchannels))
    one.format = oiio.TypeDesc(oiio.FLOAT)
    one.erase_attribute("name")
    return one


def _one_band(bands: Sequence[Band]) -> Band:
    return lambda rows: np.dstack([band(rows).astype(np.float32, copy=False) for band in bands])


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
    is_data: bool = False  # no colours: it has no colour space


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
        single = len(values.shape) == 2
        is_data = single or letters != "RGB"
        group = grouped.setdefault(name, _ExrPart(name, kind, [], [], is_data=is_data))
        group.channels.extend([layer] if single else [f"{layer}.{x}" for x in letters[: values.shape[-1]]])
        group.of.append(_in_space(values, None if is_data else space))
    yield from grouped.values()


def _in_space(values: np.ndarray, space: ColourSpace | None) -> Band:
    """Rows of colours in a space, or as they are."""
    if space is None:
        return lambda rows: rows_of(values, rows)
    return lambda rows: from_linear_rec709(rows_of(values, rows).astype(np.float32, copy=False), space)


def half_floats(path: Path, values: np.ndarray) -> tuple[np.ndarray, int]:
    """Return finite values as half floats, and how many were beyond their range."""
    data = _half(values)
    if np.isfinite(data).all():
        return data, 0
    _require_finite(path, values)
    return _half(values.clip(-HALF_MAX, HALF_MAX)), int(np.sum(np.abs(values) > HALF_MAX))


def _half(values: np.ndarray) -> np.ndarray:
    """Values as half floats; numpy alone takes several times as long."""
    return np.asarray(torch.tensor(np.ascontiguousarray(values)).half().numpy())


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
    added: Band | None = None,
    bits: Literal[8, 16] = 8,
    quality: int = JPEG_QUALITY,
) -> float:
    """Write linear Rec.709 [H, W, 3] as a PNG or JPEG, by the suffix; return the exposure in EV.

    "auto" is `colour.auto_exposure_ev` where alpha [H, W] exceeds one half. PNG keeps alpha, with colour that
    is not premultiplied; JPEG has no alpha and shows the image over black. `view`, `share` and `added`, not
    exposed, are those of `colour.encode_display`; `bits` are of a PNG, `quality` (1 to 100) of a JPEG.
    """
    chosen_ev = auto_exposure_ev(pixels, alpha) if exposure == "auto" else float(exposure)
    jpeg = path.suffix.lower() in (".jpg", ".jpeg")

    def values(rows: slice) -> np.ndarray:
        seen, opaque = rows_of(pixels, rows), None if alpha is None else rows_of(alpha, rows)
        _require_finite(path, seen)
        if opaque is not None and jpeg:
            seen = seen * opaque[..., None]
        gain = np.float32(2.0**chosen_ev)
        exposed = np.nan_to_num(seen * gain)
        more = None if added is None else added(rows) * gain
        data = encode_display(exposed, view, None if share is None else rows_of(share, rows), more)
        return data if opaque is None or jpeg else np.dstack([data, opaque.astype(np.float32)])

    spec = _spec((*pixels.shape[:2], 3 if alpha is None or jpeg else 4), f"uint{8 if jpeg else bits}")
    spec.attribute("oiio:UnassociatedAlpha", 1)
    if view.is_srgb:
        spec.attribute("oiio:ColorSpace", "sRGB")
    spec.attribute("CompressionQuality", quality)
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
        set_attribute(specs[0], name, value)
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
