"""Image files of any supported format, read as scene-linear float32 Rec.709, top row first:

    read_image ─ decode ─ open_image (chooses a layer) ─ upright ─ spaces.stated_space ─ to_linear_rec709

OpenImageIO reads all formats except HEIC and AVIF (`isobmff.py`); `workarounds.py` fills its gaps.
Data and display windows apply only to EXR: in other formats an offset positions a page or a stamp.
"""

import logging
import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from tokenize import TokenError
from typing import Any, Literal, NamedTuple

import numpy as np
import OpenImageIO as oiio

from facerf_cli.errors import InputError
from facerf_cli.files import isobmff, workarounds
from facerf_cli.files.icc import srgb_of_inks, srgb_of_tables
from facerf_cli.files.layers import chosen_layer, first_channels
from facerf_cli.files.spaces import (
    default_space,
    is_floating,
    is_ultra_hdr,
    profile_of,
    profile_of_tables,
    stated_space,
)
from facerf_cli.files.texts import require_regular
from facerf_cli.image.colour import LINEAR, SRGB, ColourSpace, named_space, to_linear_rec709, unit_floats
from facerf_cli.image.strips import resized, strips
from facerf_cli.run import memory
from facerf_cli.run.logs import LOGGER_NAME, one_line

PHOTO_LIMIT_PX = 64_000_000
ENVMAP_LIMIT_PX = 134_300_000  # 16k x 8k
LINEAR_BYTES, _ALPHA_BYTES = 12, 4  # per pixel: three floats, one float
_DECODED_BYTES = {"heif": isobmff.HEIF_BYTES, "avif": isobmff.AVIF_BYTES}  # per pixel during decoding
_HAVE_WINDOWS = ("openexr", "rla")
# Formats whose resolutions are meant for print and often differ by mistake; viewers show square pixels.
_PRINTED = ("jpeg", "png", "tiff")
_INTEGERS = (oiio.TypeDesc(oiio.UINT8), oiio.TypeDesc(oiio.UINT16))
_SAME_ASPECT, _MOST_ASPECT = 0.03, 8.0

log = logging.getLogger(LOGGER_NAME)


@dataclass(frozen=True)
class LinearImage:
    """Upright image in scene-linear Rec.709, not premultiplied by alpha."""

    pixels: np.ndarray  # [H, W, 3] float32
    alpha: np.ndarray | None = None  # [H, W] float32
    colourspace_name: str = LINEAR.name  # of the file's values
    metadata: dict[str, Any] = field(default_factory=dict)


class Opened(NamedTuple):
    """Open file at one layer; `colour` (one channel or three) and `alpha` are channel numbers."""

    form: str  # OpenImageIO's format name, "heif" or "avif"
    spec: oiio.ImageSpec  # with windows and an orientation that are valid in the format
    colour: list[int]
    alpha: int | None
    read: Callable[[int, int], np.ndarray]  # decodes channels [H, W, C] from the first to before the second
    choice: str = ""  # names the layer if other programs may show another one


@dataclass(frozen=True, eq=False)
class Decoded:
    """Channels [H, W, C] of a layer as stored integers or float32.

    `colour` (one channel or three) and `alpha` index `values`.
    """

    values: np.ndarray
    spec: oiio.ImageSpec
    colour: list[int]
    alpha: int | None
    is_associated: bool = False  # the colour is multiplied by alpha


def read_image(
    path: Path | str,
    colourspace: str | ColourSpace | None = None,
    limit_px: int = PHOTO_LIMIT_PX,
    non_finite: Literal["error", "zero"] = "error",
    kept_px: int = 0,
    layer: str | None = None,
    with_alpha: bool = True,
) -> LinearImage:
    """Read an image of any supported format.

    Args:
        path: The file.
        colourspace: Colour space of the values; overrides the file's statement.
        limit_px: Largest number of pixels.
        non_finite: "error" raises InputError for NaN and infinite values, "zero" logs and replaces them.
        kept_px: Bytes per pixel that the caller derives from the image, included in the memory check.
        layer: Name of an EXR layer.
        with_alpha: False ignores alpha and keeps the colour as stored (for maps, where alpha has no meaning).
    """
    path = Path(path)
    image = decode(path, limit_px, kept_px, layer, with_alpha)
    spec = image.spec
    values = _upright(_full_frame(image.values, spec), spec.get_int_attribute("Orientation", 1))
    if colourspace:
        space = named_space(colourspace) if isinstance(colourspace, str) else colourspace
        if space.decode is not None and is_floating(spec):
            log.warning("%s: floating-point values decoded by the curve of %s", path, space.name)
    elif profile := profile_of_tables(path, spec):
        name = one_line(spec.get_string_attribute("ICCProfile:profile_description"))
        values = values.copy()
        values[..., image.colour] = srgb_of_tables(path, values[..., image.colour], profile, name)
        space = SRGB
    elif (stated := stated_space(path, spec)) is not None:
        space = stated
    else:
        space = default_space(spec)
        if is_floating(spec):
            log.info("%s: does not state its colour space; read as %s", path, space.name)
    height, width = values.shape[:2]
    pixels = np.empty((height, width, 3), np.float32)
    alpha = None if image.alpha is None else np.empty((height, width), np.float32)
    used = image.colour if image.alpha is None else [*image.colour, image.alpha]
    bad = 0
    for rows in strips(values.shape):
        channels = values[rows][..., used]
        if values.dtype.kind == "f" and not (finite := np.isfinite(channels)).all():
            bad += int((~finite).any(-1).sum())
            channels = np.where(finite, channels, np.float32(0))
        colour = np.broadcast_to(channels[..., : len(image.colour)], pixels[rows].shape)
        if alpha is not None:
            alpha[rows] = unit_floats(channels[..., -1]).clip(0, 1)
            if image.is_associated:
                # rounding exceeds 1 where alpha is small
                most = np.inf if values.dtype.kind == "f" else 1.0
                colour = unit_floats(colour) / np.where(alpha[rows] > 0, alpha[rows], 1)[..., None]
                colour = colour.clip(None, most)
        pixels[rows] = to_linear_rec709(colour, space)
    if bad and non_finite == "error":
        raise InputError(f"{path}: {bad} of {height * width} pixels are NaN or infinite; replace them")
    if bad:
        log.warning("%s: %d pixels are NaN or infinite; set to 0", path, bad)
    if (size := shown_size(spec)) != (height, width):
        log.info("%s: pixels are not square; resampled to %d x %d", path, size[1], size[0])
        pixels = resized(pixels, *size)
        alpha = None if alpha is None else resized(alpha, *size)
    return LinearImage(pixels, alpha, space.name, metadata_of(spec))


def decode(
    path: Path, limit_px: int, kept_px: int = 0, layer: str | None = None, with_alpha: bool = True
) -> Decoded:
    """Decode the colour and alpha channels of a layer, and any channels between them.

    The number of pixels and the memory budget are checked first: for the channels, and for a linear image
    with `kept_px` bytes per pixel that the caller derives from it after the channels are freed.
    """
    require_regular(path, "specify an image file")
    if not path.stat().st_size:
        raise InputError(f"{path}: the file is empty; specify an image file")
    for _ in workarounds.png_chunks(path):  # checks all of them
        pass
    with open_image(path, layer, limit_px) as image:
        form, spec = image.form, image.spec
        if image.choice:
            log.info("%s: %s", path, image.choice)
        alpha = image.alpha if with_alpha and not is_ultra_hdr(path, spec) else None
        alpha = None if workarounds.lacks_alpha(form, spec) else alpha
        used = image.colour if alpha is None else [*image.colour, alpha]
        first, past = min(used), max(used) + 1
        kind = spec.format if spec.format in _INTEGERS else oiio.TypeDesc(oiio.FLOAT)
        height, width = shown_size(spec)
        pixels = max(spec.width * spec.height, height * width)
        size = f"{path}: {spec.width} x {spec.height} pixels"
        if pixels > limit_px:
            raise InputError(f"{size}; the limit is {limit_px / 1e6:.0f} megapixels, so make it smaller")
        linear_bytes = LINEAR_BYTES + _ALPHA_BYTES * (spec.alpha_channel >= 0)
        decoded_bytes = _DECODED_BYTES.get(form, (past - first) * kind.size())
        memory.require(size, pixels * (linear_bytes + max(decoded_bytes, kept_px)), "make it smaller")
        if workarounds.has_inks(spec):
            rgb = srgb_of_inks(path, profile_of(spec))
            spec.erase_attribute("ICCProfile.*")
            return Decoded(rgb, spec, [0, 1, 2], None)
        values = image.read(first, past)
    colour = [channel - first for channel in image.colour]
    alpha = None if alpha is None else alpha - first
    if alpha is None or (form == "bmp" and not values[..., alpha].any()):  # which need not be alpha
        return Decoded(values, spec, colour, None)
    if form == "jpegxl" and workarounds.looks_multiplied(values, colour, alpha):
        raise InputError(f"{path}: JPEG XL with premultiplied alpha is not supported; save it as PNG")
    return Decoded(values, spec, colour, alpha, workarounds.is_associated(path, form, spec))


@contextmanager
def open_image(path: Path, layer: str | None = None, limit_px: int = 0) -> Iterator[Opened]:
    """Open an image file at a layer, by default the main image.

    A HEIF is decoded when it is opened, if it has at most `limit_px` pixels.
    Raises InputError for unknown and rare formats, camera raw files and missing layers.
    """
    if path.suffix.lower() in workarounds.RAW_SUFFIXES:
        raise InputError(f"{path}: {workarounds.UNDEVELOPED}")
    if form := isobmff.kind_of(path):
        is_avif = form == "avif"
        spec, decode_all = isobmff.open_avif(path) if is_avif else isobmff.open_heif(path, limit_px)
        yield Opened(form, spec, *first_channels(spec), lambda first, past: decode_all()[..., first:past])
        return
    settings = oiio.ImageSpec()
    settings.attribute("oiio:UnassociatedAlpha", 1)
    stream = oiio.ImageInput.open(workarounds.utf8_path(path), settings)
    if stream is None:
        cause = workarounds.reason(path, workarounds.oiio_error())
        raise InputError(f"{path}: not a readable image; save it as EXR, PNG or JPEG ({cause})")
    try:
        form, warnings = stream.format_name(), workarounds.oiio_error(stream)
        specs = [stream.spec()]
        while form == "openexr" or (form == "tiff" and len(specs) == 1):
            if not stream.seek_subimage(len(specs), 0):
                break
            specs.append(stream.spec())
        workarounds.oiio_error(stream)  # clears the error about the missing part
        chosen, choice = chosen_layer(path, specs if form == "openexr" else specs[:1], layer)
        spec = oiio.ImageSpec(specs[chosen.part])
        workarounds.refuse_rare(path, form, spec, specs[1] if form == "tiff" and len(specs) > 1 else None)
        stream.seek_subimage(chosen.part, 0)
        exposure = workarounds.radiance_exposure(path, spec) if form == "hdr" else 1.0
        if form not in _HAVE_WINDOWS:
            spec.x = spec.y = spec.full_x = spec.full_y = 0
            spec.full_width, spec.full_height = spec.width, spec.height
        if form in _PRINTED:
            spec.erase_attribute("PixelAspectRatio")
        if not 1 <= spec.get_int_attribute("Orientation", 1) <= 8:
            spec.attribute("Orientation", 1)

        def read(first: int, past: int) -> np.ndarray:
            kind = spec.format if spec.format in _INTEGERS else oiio.TypeDesc(oiio.FLOAT)
            values = stream.read_image(chosen.part, 0, first, past, kind)
            workarounds.require_whole(path, values, f"{warnings}\n{workarounds.oiio_error(stream)}")
            values = np.asarray(values).reshape(spec.height, spec.width, past - first)
            return values if exposure == 1 else values / np.float32(exposure)

        yield Opened(form, spec, chosen.colour, chosen.alpha, read, choice)
    finally:
        stream.close()


def _full_frame(values: np.ndarray, spec: oiio.ImageSpec) -> np.ndarray:
    """Paste an EXR's data window into its display window, which is 0 elsewhere."""
    x, y = spec.x - spec.full_x, spec.y - spec.full_y
    if (x, y, spec.width, spec.height) == (0, 0, spec.full_width, spec.full_height):
        return values
    frame = np.zeros((spec.full_height, spec.full_width, values.shape[2]), values.dtype)
    top, left = max(y, 0), max(x, 0)
    part = values[max(-y, 0) :, max(-x, 0) :]
    part = part[: max(spec.full_height - top, 0), : max(spec.full_width - left, 0)]
    frame[top : top + part.shape[0], left : left + part.shape[1]] = part
    return frame


def _upright(values: np.ndarray, orientation: int) -> np.ndarray:
    """Rotate and mirror an image [H, W, C] to undo EXIF orientation 1 to 8."""
    if orientation >= 5:
        values = values.swapaxes(0, 1)
    flip_rows, flip_columns = orientation in (3, 4, 7, 8), orientation in (2, 3, 6, 7)
    return values[:: -1 if flip_rows else 1, :: -1 if flip_columns else 1]


def shown_size(spec: oiio.ImageSpec) -> tuple[int, int]:
    """Return the height and width of an image that is upright and has square pixels."""
    height, width = spec.full_height, spec.full_width
    aspect = spec.get_float_attribute("PixelAspectRatio", 1.0)  # may be NaN
    if 1 / _MOST_ASPECT <= aspect <= _MOST_ASPECT and abs(aspect - 1) > _SAME_ASPECT:
        height, width = (height, round(width * aspect)) if aspect > 1 else (round(height / aspect), width)
    return (width, height) if spec.get_int_attribute("Orientation", 1) >= 5 else (height, width)


def metadata_of(spec: oiio.ImageSpec) -> dict[str, Any]:
    """Return the attributes that are text, numbers or tuples, without the orientation."""
    attributes = {}
    for entry in spec.extra_attribs:
        with suppress(UnicodeDecodeError):  # text in another encoding
            if entry.name != "Orientation" and isinstance(entry.value, (str, int, float, tuple)):
                attributes[entry.name] = entry.value
    return attributes


def read_array(path: Path) -> np.ndarray:
    """Read a NumPy array (.npy) of floats [H, W, 3] or [H, W], linear Rec.709, as [H, W, 3] float32."""
    require_regular(path, "specify an image as .npy")
    try:
        # memory-mapped, since a header may promise more data than exists
        values = np.load(path, mmap_mode="r", allow_pickle=False)
    except (OSError, ValueError, EOFError, SyntaxError, TokenError, OverflowError, TypeError) as error:
        raise InputError(f"{path}: not an array of numbers ({error}); write it with numpy.save") from None
    if values.ndim not in (2, 3) or values.shape[2:] not in ((), (3,)) or not math.prod(values.shape):
        raise InputError(f"{path}: array of shape {list(values.shape)}; use [height, width, 3]")
    if math.prod(values.shape[:2]) > PHOTO_LIMIT_PX:
        raise InputError(f"{path}: more than {PHOTO_LIMIT_PX / 1e6:.0f} megapixels; make it smaller")
    if values.dtype.kind != "f":
        raise InputError(f"{path}: values of type {values.dtype}; use floats of linear light, or a PNG")
    image = np.broadcast_to(values.reshape(*values.shape[:2], -1), (*values.shape[:2], 3)).astype(np.float32)
    if not np.isfinite(image).all():
        raise InputError(f"{path}: contains NaN or infinite values; replace them")
    return image
