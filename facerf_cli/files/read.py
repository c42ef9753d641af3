"""Image files of any encoding, read as scene-linear float32 Rec.709.

    read_image ─ decode ─ open_image (a layer) ─ _stored ─ upright ─ spaces.stated_space ─ to_linear_rec709

OpenImageIO reads all formats but HEIC and AVIF (`isobmff.py`); what it leaves out of some is in `quirks.py`.
Data and display windows are EXR's alone: elsewhere an offset places a page or a stamp.
"""

import logging
import re
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
import OpenImageIO as oiio

from facerf_cli.errors import InputError
from facerf_cli.files import isobmff, quirks
from facerf_cli.files.layers import ImageLayer, chosen_layer, first_channels
from facerf_cli.files.spaces import default_space, is_floating, is_ultra_hdr, stated_space
from facerf_cli.files.texts import require_regular
from facerf_cli.image.colour import LINEAR, ColourSpace, named_space, to_linear_rec709, unit_floats
from facerf_cli.image.strips import resized, strips
from facerf_cli.run import memory
from facerf_cli.run.logs import LOGGER_NAME, one_line

PHOTO_LIMIT_PX = 64_000_000
ENVMAP_LIMIT_PX = 134_300_000  # 16k x 8k
LINEAR_BYTES = 12  # of a pixel that is read: three floats, and
_ALPHA_BYTES = 4
_RAW = (
    ".3fr .arw .cr2 .cr3 .crw .dcr .dng .erf .fff .iiq .kdc .mef .mos .mrw .nef .nrw .orf .pef .raf .raw .rw2"
    " .rwl .sr2 .srf .srw .x3f"
)
_RAW_SUFFIXES = frozenset(_RAW.split())
_UNDEVELOPED = (  # OpenImageIO reads its thumbnail
    "a raw file of a camera, or a thumbnail first, is not read; develop it to EXR, TIFF or JPEG, as with"
    " darktable or RawTherapee"
)
_HAVE_WINDOWS = ("openexr", "rla")
# Formats whose two resolutions are for print, and differ by mistake; viewers show their pixels square.
_PRINTED = ("jpeg", "png", "tiff")
# Formats whose colour is multiplied by alpha, unless the header says otherwise.
_ASSOCIATED = ("openexr", "tiff", "targa", "rla", "iff", "dpx", "softimage")
_TGA_ALPHA = 4
_INTEGERS = (oiio.TypeDesc(oiio.UINT8), oiio.TypeDesc(oiio.UINT16))
_INKS = 4  # cyan, magenta, yellow, black
_UNSUPPORTED = re.compile(
    r"unsupported|not (supported|configured|implemented|available)|unknown compression", re.I
)
_SAME_ASPECT, _MOST_ASPECT = 0.03, 8.0

log = logging.getLogger(LOGGER_NAME)


@dataclass(frozen=True)
class LinearImage:
    """An upright image in scene-linear Rec.709; the colour is not premultiplied by alpha."""

    pixels: np.ndarray  # [H, W, 3] float32
    alpha: np.ndarray | None = None  # [H, W] float32
    colourspace_name: str = LINEAR.name  # the colour space from which the file was decoded
    metadata: dict[str, Any] = field(default_factory=dict)


class Opened(NamedTuple):
    """An open file at the layer that is read.

    `spec` is the layer's header, with windows and an orientation that are valid in its format. `said` is what
    its reader says as it opens, as of a progressive JPEG that is cut short.
    """

    stream: Any
    spec: oiio.ImageSpec
    layer: ImageLayer
    choice: str  # says which layer is read, where it is not what any program shows
    hdr: quirks.RadianceHeader | None
    said: str


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
        colourspace: The space of its values, in place of what the file states.
        limit_px: The most pixels that are read.
        non_finite: NaN and infinite values raise an InputError, or are set to 0 with a warning ("zero").
        kept_px: Bytes a pixel that the caller makes of the image: the budget of memory is asked for both.
        layer: The name of a layer of an EXR.
        with_alpha: Without alpha the colour is as it is stored: of a map it is light, and covers nothing.
    """
    path = Path(path)
    found = decode(path, limit_px, kept_px, layer, with_alpha)
    spec = found.spec
    values = _upright(_full_frame(found.values, spec), spec.get_int_attribute("Orientation", 1))
    if colourspace:
        space = named_space(colourspace) if isinstance(colourspace, str) else colourspace
        if space.decode is not None and is_floating(spec):
            log.warning("%s: floating-point values decoded by the curve of %s", path, space.name)
    elif stated := stated_space(path, spec):
        space = stated
    else:
        space = default_space(spec)
        if is_floating(spec):
            log.info("%s: does not say its colour space; read as %s", path, space.name)
    height, width = values.shape[:2]
    pixels = np.empty((height, width, 3), np.float32)
    alpha = None if found.alpha is None else np.empty((height, width), np.float32)
    used = found.colour if found.alpha is None else [*found.colour, found.alpha]
    bad = 0
    for rows in strips(values.shape):
        channels = values[rows][..., used]
        finite = np.isfinite(channels)
        if not finite.all():
            bad += int((~finite).any(-1).sum())
            channels = np.where(finite, channels, np.float32(0))
        colour = np.broadcast_to(channels[..., : len(found.colour)], pixels[rows].shape)
        if alpha is not None:
            alpha[rows] = unit_floats(channels[..., -1]).clip(0, 1)
            if found.is_associated:
                # rounding exceeds 1 where alpha is small
                most = np.inf if values.dtype.kind == "f" else 1.0
                colour = unit_floats(colour) / np.where(alpha[rows] > 0, alpha[rows], 1)[..., None]
                colour = colour.clip(None, most)
        pixels[rows] = to_linear_rec709(colour, space)
    if bad and non_finite == "error":
        raise InputError(f"{path}: {bad} of {height * width} pixels are NaN or infinite; replace them first")
    if bad:
        log.warning("%s: %d pixels are NaN or infinite; their values are set to 0", path, bad)
    if (size := shown_size(spec)) != (height, width):
        log.info("%s: its pixels are not square; read at %d x %d", path, size[1], size[0])
        pixels = resized(pixels, *size)
        alpha = None if alpha is None else resized(alpha, *size)
    return LinearImage(pixels, alpha, space.name, metadata_of(spec))


def metadata_of(spec: oiio.ImageSpec) -> dict[str, Any]:
    """Return the attributes that are text, numbers or tuples, without the orientation."""
    attributes = {}
    for entry in spec.extra_attribs:
        with suppress(UnicodeDecodeError):  # of a text in another encoding
            if entry.name != "Orientation" and isinstance(entry.value, (str, int, float, tuple)):
                attributes[entry.name] = entry.value
    return attributes


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
    kind = isobmff.kind_of(path)
    if not kind:
        quirks.require_whole_png(path)
        with open_image(path, layer) as opened:
            return _decoded(path, opened, limit_px, kept_px, with_alpha)
    if kind == "avif":
        image, spec = isobmff.open_avif(path)
        _require_room(path, spec, limit_px, isobmff.AVIF_BYTES, kept_px)
        values = isobmff.decode_avif(path, image, spec)
    else:
        bytes_px = LINEAR_BYTES + max(isobmff.HEIF_BYTES, kept_px)
        values, spec = isobmff.decode_heif(path, limit_px, bytes_px)
    colour, alpha = first_channels(spec)
    is_associated = not spec.get_int_attribute("oiio:UnassociatedAlpha")
    return Decoded(values, spec, colour, alpha if with_alpha else None, is_associated)


def read_in_one_thread() -> None:
    """Let images be read by the thread that asks, also in processes that are forked from now on.

    A forked process has none of the threads that OpenImageIO has begun; on a machine of many cores it would
    wait for them without end.
    """
    oiio.attribute("threads", 1)


@contextmanager
def open_image(path: Path, layer: str | None = None) -> Iterator[Opened]:
    """Open an image file at a layer, by default the image.

    Raises InputError for what is not read: unknown formats, raw files of cameras, a layer that is not there.
    """
    if path.suffix.lower() in _RAW_SUFFIXES:
        raise InputError(f"{path}: {_UNDEVELOPED}")
    settings = oiio.ImageSpec()
    settings.attribute("oiio:UnassociatedAlpha", 1)
    stream = oiio.ImageInput.open(utf8_path(path), settings)
    if stream is None:
        said = _reason(path, oiio_error())
        quirks.require_rgb_radiance(path)
        raise InputError(f"{path}: not a readable image; save it again as EXR, PNG or JPEG ({said})")
    try:
        form = stream.format_name()
        said = oiio_error(stream)
        specs = [stream.spec()]
        while (form == "openexr" or (form == "tiff" and len(specs) == 1)) and stream.seek_subimage(
            len(specs), 0
        ):
            specs.append(stream.spec())
        oiio_error(stream)  # that there are no more
        if form == "tiff" and quirks.is_raw_tiff(path, *specs):
            raise InputError(f"{path}: {_UNDEVELOPED}")
        chosen, choice = chosen_layer(path, specs if form == "openexr" else specs[:1], layer)
        if specs[chosen.part].deep:
            raise InputError(f"{path}: a deep image is not read; flatten it, as by oiiotool --flatten")
        stream.seek_subimage(chosen.part, 0)
        spec = oiio.ImageSpec(specs[chosen.part])
        hdr = quirks.read_radiance_header(path, spec) if form == "hdr" else None
        if form not in _HAVE_WINDOWS:
            spec.x = spec.y = spec.full_x = spec.full_y = 0
            spec.full_width, spec.full_height = spec.width, spec.height
        if form in _PRINTED:
            spec.erase_attribute("PixelAspectRatio")
        if not 1 <= spec.get_int_attribute("Orientation", 1) <= 8:
            spec.attribute("Orientation", 1)
        yield Opened(stream, spec, chosen, choice, hdr, said)
    finally:
        stream.close()


def _decoded(path: Path, opened: Opened, limit_px: int, kept_px: int, with_alpha: bool) -> Decoded:
    form, spec, layer = opened.stream.format_name(), opened.spec, opened.layer
    if form == "dpx" and spec.get_int_attribute("Orientation", 1) >= 5:
        raise InputError(f"{path}: a DPX file that lies on its side is not read; save it upright")
    colours = spec.get_int_attribute("tiff:PhotometricInterpretation", -1)
    if colours == quirks.CIELAB:
        raise InputError(f"{path}: a TIFF in CIELAB is not read; save it in RGB")
    if form == "psd":
        quirks.require_composite(path)
    if opened.choice:
        log.info("%s: %s", path, opened.choice)
    is_associated = form in _ASSOCIATED and not spec.get_int_attribute("oiio:UnassociatedAlpha", 0)
    # A TGA may say of its fourth channel nothing, or that it is alpha.
    says_none = (
        form == "targa" and is_associated and spec.get_int_attribute("targa:alpha_type", 0) != _TGA_ALPHA
    )
    alpha = None if not with_alpha or says_none or is_ultra_hdr(path, spec) else layer.alpha
    used = layer.colour if alpha is None else [*layer.colour, alpha]
    has_inks = colours == quirks.SEPARATED and spec.nchannels > _INKS
    first, past = (0, spec.nchannels) if has_inks else (min(used), max(used) + 1)
    kind = spec.format if spec.format in _INTEGERS else oiio.TypeDesc(oiio.FLOAT)
    _require_room(path, spec, limit_px, (past - first) * kind.size(), kept_px)
    if not has_inks and (rgb := quirks.by_profile_of_inks(path, spec)) is not None:
        spec.erase_attribute("ICCProfile.*")
        return Decoded(rgb, spec, [0, 1, 2], None)
    values = _stored(path, opened, first, past, kind)
    if has_inks:
        spec.attribute("oiio:ColorSpace", "")
        extra = quirks.extra_channel(path) if with_alpha else 0
        values = quirks.rgb_of_inks(unit_floats(values), extra)
        return Decoded(values, spec, [0, 1, 2], 3 if extra in quirks.ALPHA else None)
    if alpha is None:
        is_associated = False
    elif is_associated and form == "tiff":  # OpenImageIO says so without the tag, too
        is_associated = quirks.extra_channel(path) == quirks.ASSOCIATED
    elif form == "jpegxl":
        is_associated = isobmff.multiplies_alpha(path)
    alpha = None if alpha is None else alpha - first
    if colours == quirks.WHITE_IS_ZERO:
        values = quirks.black_is_zero(values, alpha)
    if form == "bmp" and alpha is not None and not values[..., alpha].any():
        alpha = None  # the fourth byte need not be alpha
    return Decoded(values, spec, [channel - first for channel in layer.colour], alpha, is_associated)


def _stored(path: Path, opened: Opened, first: int, past: int, kind: oiio.TypeDesc) -> np.ndarray:
    """Decode some channels [H, W, C]."""
    stream, hdr, spec = opened.stream, opened.hdr, opened.spec
    if stream.format_name() == "cineon":
        quirks.require_whole_cineon(path, spec)
    values = quirks.read_old_runs(path, hdr) if hdr else None
    if values is None:
        values = stream.read_image(opened.layer.part, 0, first, past, kind)
    said = f"{opened.said}\n{oiio_error(stream)}"
    message = _reason(path, said)
    if values is None and _UNSUPPORTED.search(message):
        raise InputError(f"{path}: its compression is not supported; save it with another ({message})")
    if values is None or "premature end" in said.lower():  # a JPEG cut short decodes to grey
        raise InputError(f"{path}: damaged or cut short; copy it again ({message or 'no pixels in it'})")
    if message:
        log.warning("%s: %s", path, message)
    values = np.asarray(values).reshape(spec.height, spec.width, past - first)
    return values / hdr.scale if hdr and (hdr.scale != 1).any() else values


def _require_room(path: Path, spec: oiio.ImageSpec, limit_px: int, stored_px: int, kept_px: int) -> None:
    height, width = shown_size(spec)
    pixels = max(spec.width * spec.height, height * width)
    image = f"{path}: {spec.width} x {spec.height} pixels"
    if pixels > limit_px:
        most = f"at most {limit_px / 1e6:.0f} megapixels are read"
        raise InputError(f"{image}; {most}, so make it smaller")
    alpha = _ALPHA_BYTES * (spec.alpha_channel >= 0)
    memory.require(image, pixels * (LINEAR_BYTES + alpha + max(stored_px, kept_px)), "make it smaller")


def _full_frame(values: np.ndarray, spec: oiio.ImageSpec) -> np.ndarray:
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


def _upright(values: np.ndarray, orientation: int) -> np.ndarray:
    """Rotate and mirror an image [H, W, C] to undo EXIF orientation 1..8."""
    if orientation >= 5:
        values = values.swapaxes(0, 1)
    flip_rows, flip_columns = orientation in (3, 4, 7, 8), orientation in (2, 3, 6, 7)
    return values[:: -1 if flip_rows else 1, :: -1 if flip_columns else 1]


def shown_size(spec: oiio.ImageSpec) -> tuple[int, int]:
    """Height and width of an image once it is upright and its pixels are square."""
    height, width = spec.full_height, spec.full_width
    aspect = spec.get_float_attribute("PixelAspectRatio", 1.0)  # may be NaN
    if 1 / _MOST_ASPECT <= aspect <= _MOST_ASPECT and abs(aspect - 1) > _SAME_ASPECT:
        height, width = (height, round(width * aspect)) if aspect > 1 else (round(height / aspect), width)
    return (width, height) if spec.get_int_attribute("Orientation", 1) >= 5 else (height, width)


def _reason(path: Path, message: str) -> str:
    """Shorten OpenImageIO's error message to its first line, without the path."""
    line = (message.strip().splitlines() or [""])[0]
    line = re.sub(r' \("?' + re.escape(str(path)) + r'"?\)', "", line).replace(f'"{path}"', "it")
    return one_line(re.sub(r"\bEXR_ERR_\w+ |: magic 0x.*| Is it a file format .*", "", line))


def oiio_error(stream: Any = oiio) -> str:
    """Take the pending error of OpenImageIO, or of one of its streams, which need not be UTF-8.

    OpenImageIO prints an error that nobody took when the program ends.
    """
    try:
        return str(stream.geterror())
    except UnicodeDecodeError as error:
        return error.object.decode(errors="replace")


def utf8_path(path: Path) -> str:
    """Return the path for OpenImageIO, which takes only UTF-8; raise an InputError for any other name."""
    try:
        path.as_posix().encode()
    except UnicodeEncodeError:
        raise InputError(
            f"{str(path)!a}: the name is not UTF-8; rename the file, or the folder that it is in"
        ) from None
    return str(path)
