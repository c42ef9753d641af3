"""Image files to their values as they are stored: one layer, upright, its colour apart from alpha."""

import io
import logging
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import OpenImageIO as oiio

from facerf_cli.errors import InputError
from facerf_cli.files.avif import AVIF_BYTES, decode_avif, is_avif, open_avif
from facerf_cli.files.heif import HEIF_BYTES, decode_heif, is_heif
from facerf_cli.files.image_metadata import require_whole_png
from facerf_cli.files.image_parts import (
    OpenedImage,
    oiio_error,
    open_image,
    pick_channels,
    reason,
    shown_size,
)
from facerf_cli.files.jpeg_xl import multiplies_alpha
from facerf_cli.files.radiance import read_old_runs
from facerf_cli.files.stated_space import by_pillow, is_ultra_hdr
from facerf_cli.files.texts import require_regular
from facerf_cli.image.colour import unit_floats
from facerf_cli.run import memory
from facerf_cli.run.logs import LOGGER_NAME

LINEAR_BYTES = 12  # of a pixel that is read: three floats, and
_ALPHA_BYTES = 4
_INTEGERS = (oiio.TypeDesc(oiio.UINT8), oiio.TypeDesc(oiio.UINT16))
_UNSUPPORTED = re.compile(
    r"unsupported|not (supported|configured|implemented|available)|unknown compression", re.I
)
_WHITE_IS_ZERO, _SEPARATED, _CIELAB = 0, 5, 8  # a TIFF's photometric interpretations
_EXTRA_SAMPLES, _ASSOCIATED, _UNASSOCIATED = 338, 1, 2  # a TIFF's tag, and its values
_CINEON_LITTLE = b"\xd7\x5f\x2a\x80"  # the first four bytes of a little-endian Cineon file
_PSD_VERSION, _HAS_COMPOSITE = 1057, 4  # a PSD's resource, and the place of a byte in it
_INKS = 4  # cyan, magenta, yellow, black

log = logging.getLogger(LOGGER_NAME)


@dataclass(frozen=True, eq=False)
class Decoded:
    """Some channels [H, W, C] of a file's layer: integers as they are stored, or float32.

    `colour` has one channel or three; they and `alpha` count from the first channel of `values`. The colour
    is multiplied by alpha if it `is_associated`.
    """

    values: np.ndarray
    spec: oiio.ImageSpec
    colour: list[int]
    alpha: int | None
    is_associated: bool = False


def decode(
    path: Path, limit_px: int, kept_px: int = 0, layer: str | None = None, with_alpha: bool = True
) -> Decoded:
    """Decode the channels of colour and alpha of a layer, and those between them.

    Before pixels are decoded their number is checked, and the budget of memory is asked for the channels, a
    linear image, and `kept_px` bytes a pixel that the caller makes of it once the channels are gone.
    """
    require_regular(path, "give an image file")
    if not path.stat().st_size:
        raise InputError(f"{path}: the file is empty; give an image file")
    if is_avif(path) or is_heif(path):
        if is_avif(path):
            image, spec = open_avif(path)
            _require_room(path, spec, limit_px, AVIF_BYTES, kept_px)
            values = decode_avif(path, image, spec)
        else:
            values, spec = decode_heif(path, limit_px, LINEAR_BYTES + max(HEIF_BYTES, kept_px))
        colour, alpha = pick_channels(spec)
        is_associated = not spec.get_int_attribute("oiio:UnassociatedAlpha")
        return Decoded(values, spec, colour, alpha if with_alpha else None, is_associated)
    require_whole_png(path)
    opened = open_image(path, layer)
    try:
        found = _decode_by_oiio(path, opened, limit_px, kept_px, with_alpha)
    finally:
        opened.stream.close()
    is_empty = found.alpha is not None and not found.values[..., found.alpha].any()
    if is_empty and opened.stream.format_name() == "bmp":  # whose fourth byte need not be alpha
        return Decoded(found.values, found.spec, found.colour, None)
    return found


def _decode_by_oiio(
    path: Path, opened: OpenedImage, limit_px: int, kept_px: int, with_alpha: bool
) -> Decoded:
    stream, spec, layer = opened.stream, opened.spec, opened.layer
    if stream.format_name() == "dpx" and spec.get_int_attribute("Orientation", 1) >= 5:
        raise InputError(f"{path}: a DPX file that lies on its side is not read; save it upright")
    colours = spec.get_int_attribute("tiff:PhotometricInterpretation", -1)
    if colours == _CIELAB:
        raise InputError(f"{path}: a TIFF in CIELAB is not read; save it in RGB")
    if stream.format_name() == "psd":
        resources = by_pillow(path, lambda image: {number: data for number, _, data in image.resources}) or {}
        if resources.get(_PSD_VERSION, b"")[_HAS_COMPOSITE:][:1] == b"\0":
            advice = "save it with Maximize Compatibility, or as PNG"
            raise InputError(f"{path}: a PSD without a composite of its layers is not read; {advice}")
    if opened.choice:
        log.info("%s: %s", path, opened.choice)
    alpha = layer.alpha if with_alpha and opened.has_alpha and not is_ultra_hdr(path, spec) else None
    used = layer.colour if alpha is None else [*layer.colour, alpha]
    has_inks = colours == _SEPARATED and spec.nchannels > _INKS
    first, past = (0, spec.nchannels) if has_inks else (min(used), max(used) + 1)
    kind = spec.format if spec.format in _INTEGERS else oiio.TypeDesc(oiio.FLOAT)
    _require_room(path, spec, limit_px, (past - first) * kind.size(), kept_px)
    if not has_inks and (rgb := _by_profile_of_inks(path, spec)) is not None:
        spec.erase_attribute("ICCProfile.*")
        return Decoded(rgb, spec, [0, 1, 2], None)
    values = _stored_values(path, opened, first, past, kind)
    if has_inks:
        spec.attribute("oiio:ColorSpace", "")
        return _without_inks(values, spec, _extra_channel(path) if with_alpha else 0)
    is_associated = opened.is_associated and alpha is not None
    if is_associated and stream.format_name() == "tiff":  # OpenImageIO says so without the tag, too
        is_associated = _extra_channel(path) == _ASSOCIATED
    elif alpha is not None and stream.format_name() == "jpegxl":
        is_associated = multiplies_alpha(path)
    alpha = None if alpha is None else alpha - first
    if colours == _WHITE_IS_ZERO:
        values = _black_is_zero(values, alpha)
    return Decoded(values, spec, [channel - first for channel in layer.colour], alpha, is_associated)


def _stored_values(path: Path, opened: OpenedImage, first: int, past: int, kind: oiio.TypeDesc) -> np.ndarray:
    """Decode some channels [H, W, C]."""
    stream, radiance, spec = opened.stream, opened.radiance, opened.spec
    if stream.format_name() == "cineon":
        _require_whole_cineon(path, spec)
    values = read_old_runs(path, radiance) if radiance else None
    if values is None:
        values = stream.read_image(opened.layer.part, 0, first, past, kind)
    said = f"{opened.said}\n{oiio_error(stream)}"
    message = reason(path, said)
    if values is None and _UNSUPPORTED.search(message):
        raise InputError(f"{path}: its compression is not supported; save it with another ({message})")
    if values is None or "premature end" in said.lower():  # a JPEG cut short decodes to grey
        raise InputError(f"{path}: damaged or cut short; copy it again ({message or 'no pixels in it'})")
    if message:
        log.warning("%s: %s", path, message)
    values = np.asarray(values).reshape(spec.height, spec.width, past - first)
    return values / radiance.scale if radiance and (radiance.scale != 1).any() else values


def _require_whole_cineon(path: Path, spec: oiio.ImageSpec) -> None:
    """Raise InputError where 10-bit pixels are missing, three in 32 bits, which OpenImageIO leaves black."""
    with path.open("rb") as stream:
        magic, at = stream.read(4), stream.read(4)
    start = int.from_bytes(at, "little" if magic == _CINEON_LITTLE else "big")
    if path.stat().st_size < start + 4 * -(-spec.width * spec.height * spec.nchannels // 3):
        raise InputError(f"{path}: damaged or cut short; copy it again (pixels are missing)")


def _black_is_zero(values: np.ndarray, alpha: int | None) -> np.ndarray:
    """Undo white-is-zero [H, W, C]; OpenImageIO has done it to 8 bits, of alpha, too."""
    white = np.iinfo(values.dtype).max if values.dtype.kind == "u" else 1
    channels = [
        channel for channel in range(values.shape[-1]) if (channel == alpha) == (values.dtype == np.uint8)
    ]
    values[..., channels] = white - values[..., channels]
    return values


def _by_profile_of_inks(path: Path, spec: oiio.ImageSpec) -> np.ndarray | None:
    """Convert a JPEG or TIFF of four inks to sRGB [H, W, 3] uint8 by its profile; None where it has none.

    OpenImageIO multiplies the inks, without the profile. As Photoshop does: relative colorimetric, with
    compensation of the black point.
    """
    profile = spec.getattribute("ICCProfile")
    stated = [spec.getattribute(f"{kind}:ColorSpace") for kind in ("jpeg", "tiff")]
    if profile is None or "CMYK" not in stated:
        return None
    from PIL import ImageCms  # few files need it

    def converted(image: Any) -> np.ndarray:
        source = ImageCms.getOpenProfile(io.BytesIO(bytes(profile)))
        intent, flags = ImageCms.Intent.RELATIVE_COLORIMETRIC, ImageCms.Flags.BLACKPOINTCOMPENSATION
        target = ImageCms.createProfile("sRGB")
        return np.asarray(ImageCms.profileToProfile(image, source, target, intent, "RGB", flags=flags))

    found: np.ndarray | None = by_pillow(path, converted)
    return found


def _extra_channel(path: Path) -> int:
    """The kind of a TIFF's first channel after its colours, such as `_ASSOCIATED` alpha; 0 says nothing."""
    from PIL.TiffImagePlugin import ImageFileDirectory_v2

    with path.open("rb") as stream:
        start = stream.read(16)
        directory = ImageFileDirectory_v2(start if 43 in start[2:4] else start[:8])  # 43: BigTIFF
        stream.seek(directory.next)
        directory.load(stream)
        return int(directory.get(_EXTRA_SAMPLES, (0,))[0])


def _without_inks(values: np.ndarray, spec: oiio.ImageSpec, extra: int) -> Decoded:
    """Turn inks and what follows them [H, W, 5 or more] into RGB as OpenImageIO does without alpha."""
    inks = unit_floats(values)
    alpha = inks[..., _INKS]
    if extra == _ASSOCIATED:
        inks = inks / np.where(alpha > 0, alpha, 1)[..., None]
    rgb = (1 - inks[..., :3]).clip(0, 1) * (1 - inks[..., 3:_INKS]).clip(0, 1)
    return Decoded(
        np.dstack([rgb, alpha]), spec, [0, 1, 2], 3 if extra in (_ASSOCIATED, _UNASSOCIATED) else None
    )


def _require_room(path: Path, spec: oiio.ImageSpec, limit_px: int, stored_px: int, kept_px: int) -> None:
    height, width = shown_size(spec)
    pixels = max(spec.width * spec.height, height * width)
    image = f"{path}: {spec.width} x {spec.height} pixels"
    if pixels > limit_px:
        most = f"at most {limit_px / 1e6:.0f} megapixels are read"
        raise InputError(f"{image}; {most}, so make it smaller")
    alpha = _ALPHA_BYTES * (spec.alpha_channel >= 0)
    memory.require(image, pixels * (LINEAR_BYTES + alpha + max(stored_px, kept_px)), "make it smaller")


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
