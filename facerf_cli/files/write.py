"""Image files written atomically from scene-linear Rec.709: EXR, TIFF, PNG and JPEG.

An EXR with layers has several parts: the image, which any program opens, and one part per layer, so that
tools that expect four channels find four.
"""

import logging
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Literal

import numpy as np
import OpenImageIO as oiio
import torch

from facerf_cli.errors import FacerfError, InputError, UsageError
from facerf_cli.files.atomic import atomic_path
from facerf_cli.files.icc import linear_profile
from facerf_cli.files.image_metadata import Attributes, embed_xmp, set_attribute
from facerf_cli.files.spaces import OCIO_SPACE
from facerf_cli.files.workarounds import oiio_error, utf8_path
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
)
from facerf_cli.image.strips import Rows, rows_of, strips
from facerf_cli.run.logs import LOGGER_NAME, one_line

log = logging.getLogger(LOGGER_NAME)

HALF_MAX = 65504.0  # the largest finite half float
JPEG_QUALITY = 95
_PNG_LEVEL = 4  # zlib level: half the time of 6 for 2 % more bytes
_PNG_FILTER = 32  # libpng's PNG_FILTER_UP: half the time of a choice per row, and no more bytes
_OIIO_NAMES = {
    LINEAR: "lin_rec709_scene",
    LINEAR_REC2020: "lin_rec2020_scene",
    LINEAR_P3: "lin_p3d65_scene",
    ACESCG: "lin_ap1_scene",
    ACES: "lin_ap0_scene",
}
# Channel letters and number format of data layers. Positions and UVs are single precision: at a distance of a
# metre, half floats have steps of half a millimetre.
_LAYER_CHANNELS = {
    "normal": ("XYZ", "half"),
    "position": ("XYZ", "float"),
    "depth": ("Z", "float"),
    "uv": ("UV", "float"),
}


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
    """Write linear Rec.709 [H, W, 3] as half floats in a colour space; return the number of clamped values.

    The colour must not be premultiplied; it is multiplied by alpha [H, W], as EXR requires. `layers` are
    [H, W] or [H, W, C]: normal.X/Y/Z in half, position.X/Y/Z, depth.Z and uv.U/V in float, others as R, G, B
    in half. Each name in front of the dot is a part; with `single`, all are channels of one part. Values
    beyond the range of half floats (65504) are clamped with a warning.
    """
    parts, specs = _exr_parts(pixels, alpha, layers or {}), []
    for part in parts:
        spec = new_spec((*pixels.shape[:2], len(part.channels)), part.kind)
        spec.channelnames = tuple(part.channels)
        spec.alpha_channel = 3 if part is parts[0] and alpha is not None else -1
        if len(parts) > 1:
            spec.attribute("name", part.name)
        spec.attribute("compression", compression)
        spec.attribute("oiio:ColorSpace", "data" if part.is_data else _OIIO_NAMES.get(space, space.name))
        if space.chromaticities is None:  # OpenImageIO omits unknown names
            if not part.is_data:
                spec.attribute(OCIO_SPACE, space.name)
        else:  # OpenEXR requires the same in all parts
            spec.attribute("chromaticities", oiio.TypeDesc("float[8]"), space.chromaticities)
        specs.append(spec)
    if single:
        joined = oiio.ImageSpec(specs[0])
        joined.nchannels = sum(spec.nchannels for spec in specs)
        joined.channelnames = tuple(name for spec in specs for name in spec.channelnames)
        joined.channelformats = tuple(spec.format for spec in specs for _ in range(spec.nchannels))
        joined.erase_attribute("name")
        specs = [joined]
    clamped = 0

    def joined_rows(group: Sequence[_ExrPart], rows: slice) -> np.ndarray:
        nonlocal clamped
        written = []
        for part in group:
            values = part.rows(rows, space)
            if part is parts[0] and alpha is not None:
                values[..., :3] *= values[..., 3:]
            if part.kind == "float":
                _require_finite(path, values)
                written.append(values.astype(np.float32, copy=False))
            else:
                data, count = half_floats(path, values)
                written.append(data)
                clamped += count
        return np.concatenate(written, -1)

    groups = [parts] if single else [[part] for part in parts]
    write_parts(path, specs, [partial(joined_rows, group) for group in groups], metadata)
    warn_of_clamped(path, clamped)
    return clamped


@dataclass(frozen=True, eq=False)
class _ExrPart:
    """Part of an EXR: channels of one number format from images [H, W] or [H, W, C]."""

    name: str
    kind: str
    is_data: bool  # not colour
    channels: list[str]
    images: list[tuple[np.ndarray, bool]]  # with True for colours, which are converted

    def rows(self, rows: slice, space: ColourSpace) -> np.ndarray:
        """Return rows [h, W, C] of all channels, with colours in a space."""
        parts = []
        for image, is_colour in self.images:
            values = rows_of(image, rows)
            if is_colour:
                values = from_linear_rec709(values.astype(np.float32, copy=False), space)
            parts.append(values)
        return np.dstack(parts)


def _exr_parts(
    pixels: np.ndarray, alpha: np.ndarray | None, layers: Mapping[str, np.ndarray]
) -> list[_ExrPart]:
    """Return the image, and one part for the layers of each name in front of the dot."""
    rgba = _ExrPart("rgba", "half", False, list("RGB"), [(pixels, True)])
    if alpha is not None:
        rgba.channels.append("A")
        rgba.images.append((alpha, False))
    grouped: dict[str, _ExrPart] = {}
    for layer, values in layers.items():
        letters, kind = _LAYER_CHANNELS.get(layer, ("RGB", "half"))
        name = layer.split(".")[0]
        single = len(values.shape) == 2
        is_data = single or letters != "RGB"
        part = grouped.setdefault(name, _ExrPart(name, kind, is_data, [], []))
        part.channels.extend([layer] if single else [f"{layer}.{x}" for x in letters[: values.shape[-1]]])
        part.images.append((values, not is_data))
    return [rgba, *grouped.values()]


def half_floats(path: Path, values: np.ndarray) -> tuple[np.ndarray, int]:
    """Return finite values as half floats, and the number of values that were clamped to their range."""
    data = _half(values)
    if np.isfinite(data).all():
        return data, 0
    _require_finite(path, values)
    return _half(values.clip(-HALF_MAX, HALF_MAX)), int(np.sum(np.abs(values) > HALF_MAX))


def _half(values: np.ndarray) -> np.ndarray:
    """Convert to half floats; numpy takes several times as long."""
    return np.asarray(torch.from_numpy(np.require(values, None, ("C", "W"))).half().numpy())


def warn_of_clamped(path: Path, count: int) -> None:
    """Log the number of values that were clamped to the range of half floats."""
    if count:
        log.warning("%s: %d values beyond the range of half floats are clamped to %g", path, count, HALF_MAX)


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
    """Write linear Rec.709 [H, W, 3] as a 32-bit TIFF in a colour space, with a profile if it is linear.

    The colour must not be premultiplied; the file is not either.
    """
    spec = new_spec((*pixels.shape[:2], 3 if alpha is None else 4), "float")
    spec.attribute("compression", "zip")
    spec.attribute("oiio:UnassociatedAlpha", 1)
    if space.is_linear:
        profile = np.frombuffer(linear_profile(space), np.uint8)
        spec.attribute("ICCProfile", oiio.TypeDesc(f"uint8[{len(profile)}]"), profile)

    def float_rows(rows: slice) -> np.ndarray:
        values = from_linear_rec709(rows_of(pixels, rows), space)
        _require_finite(path, values)
        if alpha is not None:
            values = np.dstack([values, rows_of(alpha, rows)])
        return values.astype(np.float32, copy=False)

    write_parts(path, [spec], [float_rows], metadata)


def write_display(
    path: Path,
    pixels: np.ndarray,
    exposure: float | Literal["auto"] = 0.0,
    alpha: np.ndarray | None = None,
    metadata: Attributes | None = None,
    view: View = PLAIN_VIEW,
    share: np.ndarray | None = None,
    added: Rows | None = None,
    bits: Literal[8, 16] = 8,
    quality: int = JPEG_QUALITY,
) -> float:
    """Write linear Rec.709 [H, W, 3] as a PNG or JPEG, by the suffix; return the exposure in EV.

    "auto" is `colour.auto_exposure_ev` where alpha [H, W] exceeds one half. PNG keeps alpha with colour that
    is not premultiplied; JPEG shows the image over black. For `view`, `share` and `added` (unexposed) see
    `colour.encode_display`; `bits` applies to PNG, `quality` (1 to 100) to JPEG.
    """
    chosen_ev = auto_exposure_ev(pixels, alpha) if exposure == "auto" else float(exposure)
    jpeg = path.suffix.lower() in (".jpg", ".jpeg")
    spec = new_spec((*pixels.shape[:2], 3 if alpha is None or jpeg else 4), f"uint{8 if jpeg else bits}")
    spec.attribute("oiio:UnassociatedAlpha", 1)
    if view.is_srgb:
        spec.attribute("oiio:ColorSpace", "sRGB")
    spec.attribute("CompressionQuality", quality)
    spec.attribute("jpeg:subsampling", "4:4:4")
    spec.attribute("png:compressionLevel", _PNG_LEVEL)
    spec.attribute("png:filter", _PNG_FILTER)
    gain = np.float32(2.0**chosen_ev)

    def encoded_rows(rows: slice) -> np.ndarray:
        colour, coverage = rows_of(pixels, rows), None if alpha is None else rows_of(alpha, rows)
        _require_finite(path, colour)
        if coverage is not None and jpeg:
            colour = colour * coverage[..., None]
        more = None if added is None else added[rows] * gain
        soft = None if share is None else rows_of(share, rows)
        data = encode_display(np.nan_to_num(colour * gain), view, soft, more)
        if coverage is not None and not jpeg:
            data = np.dstack([data, coverage.astype(np.float32)])
        return data

    write_parts(path, [spec], [encoded_rows], {"facerf:exposure_ev": chosen_ev, **(metadata or {})})
    return chosen_ev


def new_spec(shape: tuple[int, ...], kind: str) -> oiio.ImageSpec:
    """Return the header of an image [H, W, C] in a number format such as "half"."""
    spec = oiio.ImageSpec(shape[1], shape[0], shape[2], kind)
    spec.attribute("DateTime", "")  # otherwise OpenImageIO writes the time, and runs are not reproducible
    return spec


def write_parts(
    path: Path,
    specs: Sequence[oiio.ImageSpec],
    parts: Iterable[Callable[[slice], np.ndarray]],
    metadata: Attributes | None = None,
) -> None:
    """Write an image file atomically from one function per part, which returns rows [h, W, C].

    The metadata goes into the first part's header and is written as XMP. Parts are written as they arrive.
    """
    for name, value in (metadata or {}).items():
        set_attribute(specs[0], name, value)
    with atomic_path(path) as temporary:
        stream = oiio.ImageOutput.create(utf8_path(temporary))
        if stream is None:
            oiio_error()
            raise UsageError(f"{path}: unknown image format; use .exr, .png or .jpg")

        def check(good: bool) -> None:
            if not good:
                message = oiio_error(stream)
                stream.close()
                raise FacerfError(f"{path}: cannot write: {one_line(message or oiio_error(stream))}")

        check(stream.open(str(temporary), tuple(specs) if len(specs) > 1 else specs[0]))
        for number, (part, spec) in enumerate(zip(parts, specs, strict=True)):
            check(not number or stream.open(str(temporary), spec, "AppendSubimage"))
            for rows in strips((spec.height, spec.width)):
                check(stream.write_scanlines(rows.start, rows.stop, 0, np.ascontiguousarray(part(rows))))
        check(stream.close())
        embed_xmp(temporary, metadata or {})
