"""Open an image file at the part that is the image, with a header that means what its format says.

An EXR has parts and layers; of all that hold R, G and B the one is read that a renderer calls its image. Data
and display windows are EXR's alone: elsewhere an offset places a page or a stamp.
"""

import math
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import OpenImageIO as oiio

from facerf_cli.errors import InputError
from facerf_cli.files.radiance import RadianceHeader, read_radiance_header, require_rgb
from facerf_cli.run.logs import one_line

_RAW = (
    ".3fr .arw .cr2 .cr3 .crw .dcr .dng .erf .fff .iiq .kdc .mef .mos .mrw .nef .nrw .orf .pef .raf .raw .rw2"
    " .rwl .sr2 .srf .srw .x3f"
)
_RAW_SUFFIXES = frozenset(_RAW.split())
_HAVE_WINDOWS = ("openexr", "rla")
# Formats whose two resolutions are for print, and differ by mistake; viewers show their pixels square.
_PRINTED = ("jpeg", "png", "tiff")
# Formats whose colour is multiplied by alpha, unless the header says otherwise.
_ASSOCIATED = ("openexr", "tiff", "targa", "rla", "iff", "dpx", "softimage")
_TGA_ASSOCIATED = 4
_LETTERS = {"red": "r", "green": "g", "blue": "b", "alpha": "a"}
# Words in a layer's name: of the image itself, and of what else is rendered.
_IMAGE = "combined beauty rgba rgb image color colour composite final"
_OTHER = (
    "ao ambient occlusion ambientocclusion albedo depth z normal normals n p position uv motion vector"
    " velocity shadow shadows mask matte id crypto cryptomatte index mist emission env denoising"
)
_IMAGE_WORDS, _OTHER_WORDS = frozenset(_IMAGE.split()), frozenset(_OTHER.split())
_WORD = re.compile(r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+")
_MOST_NAMED = 8
_THUMBNAIL = 1  # bit of a TIFF's NewSubfileType
_RAW_COLOURS = (32803, 34892)  # a TIFF's photometric interpretations of a colour filter array, of linear raw
_SAME_ASPECT, _MOST_ASPECT = 0.03, 8.0


@dataclass(frozen=True)
class ImageLayer:
    """A layer's name, its part of the file, and the indices of its colour (one or three) and its alpha."""

    name: str
    part: int
    colour: list[int]
    alpha: int | None = None


@dataclass(frozen=True, eq=False)
class OpenedImage:
    """An open file, and its layer that is read.

    `spec` is the layer's header, with windows and an orientation that are valid in its format. `choice` says
    which layer that is, where it is not what any program shows; `said` is what its reader says as it
    opens, as of a progressive JPEG that is cut short.
    """

    stream: Any
    spec: oiio.ImageSpec
    layer: ImageLayer
    choice: str = ""
    radiance: RadianceHeader | None = None  # of a .hdr
    said: str = ""

    @property
    def is_associated(self) -> bool:
        """True if the colour is multiplied by alpha."""
        stated = self.spec.get_int_attribute("oiio:UnassociatedAlpha", 0)
        return self.stream.format_name() in _ASSOCIATED and not stated

    @property
    def has_alpha(self) -> bool:
        """False for the fourth channel of a TGA that says of none that it is alpha."""
        is_known = self.spec.get_int_attribute("targa:alpha_type", 0) == _TGA_ASSOCIATED
        return self.stream.format_name() != "targa" or is_known or not self.is_associated


def open_image(path: Path, layer: str | None = None) -> OpenedImage:
    """Open an image file at a layer, by default the image; the caller closes its stream.

    Raises InputError for what is not read: unknown formats, raw files of cameras, a layer that is not there.
    """
    _require_developed(path, path.suffix.lower() in _RAW_SUFFIXES)
    settings = oiio.ImageSpec()
    settings.attribute("oiio:UnassociatedAlpha", 1)
    stream = oiio.ImageInput.open(utf8_path(path), settings)
    if stream is None:
        said = reason(path, oiio_error())
        require_rgb(path)
        raise InputError(f"{path}: not a readable image; save it again as EXR, PNG or JPEG ({said})")
    try:
        return _at_layer(path, stream, layer)
    except InputError:
        stream.close()
        raise


def _at_layer(path: Path, stream: Any, wanted: str | None) -> OpenedImage:
    is_exr = stream.format_name() == "openexr"
    said = oiio_error(stream)
    specs = [stream.spec()]
    is_tiff = stream.format_name() == "tiff"
    while (is_exr or (is_tiff and len(specs) == 1)) and stream.seek_subimage(len(specs), 0):
        specs.append(stream.spec())
    oiio_error(stream)  # that there are no more
    _require_developed(path, is_tiff and _is_raw(path, *specs))
    layers = list(_layers(specs if is_exr else specs[:1]))
    if wanted is not None:
        chosen = _named(path, layers, wanted)
    else:
        chosen = min(layers, key=_rank, default=ImageLayer("", 0, *pick_channels(specs[0])))
    if specs[chosen.part].deep:
        raise InputError(f"{path}: a deep image is not read; flatten it, as by oiiotool --flatten")
    stream.seek_subimage(chosen.part, 0)
    spec = oiio.ImageSpec(specs[chosen.part])
    radiance = read_radiance_header(path) if stream.format_name() == "hdr" else None
    if radiance:
        radiance.describe(spec)
    if stream.format_name() not in _HAVE_WINDOWS:
        spec.x = spec.y = spec.full_x = spec.full_y = 0
        spec.full_width, spec.full_height = spec.width, spec.height
    if stream.format_name() in _PRINTED:
        spec.erase_attribute("PixelAspectRatio")
    if not 1 <= spec.get_int_attribute("Orientation", 1) <= 8:
        spec.attribute("Orientation", 1)
    return OpenedImage(stream, spec, chosen, _choice(chosen, layers, specs), radiance, said)


def _choice(chosen: ImageLayer, layers: Sequence[ImageLayer], specs: Sequence[oiio.ImageSpec]) -> str:
    """Name a layer that is chosen among others; empty for the R, G, B of the first part."""
    parts = [spec.get_string_attribute("oiio:subimagename") for spec in specs]
    if not chosen.name or (chosen.part, chosen.name) == (0, parts[0]):
        return ""
    others = dict.fromkeys([*parts, *(layer.name for layer in layers)])
    others.pop(chosen.name, None)
    beside = ", ".join(filter(None, list(others)[:_MOST_NAMED]))
    return f"the layer {one_line(chosen.name)} is read" + (f", not {one_line(beside)}" if beside else "")


def _require_developed(path: Path, is_raw: bool) -> None:
    """Raise InputError for a raw file of a camera, of which OpenImageIO reads the thumbnail."""
    if is_raw:
        advice = "develop it to EXR, TIFF or JPEG, as with darktable or RawTherapee"
        raise InputError(f"{path}: a raw file of a camera, or a thumbnail first, is not read; {advice}")


def _is_raw(path: Path, spec: oiio.ImageSpec, following: oiio.ImageSpec | None = None) -> bool:
    """Return whether a TIFF has a thumbnail first, before its next image, or the values of a sensor."""
    with path.open("rb") as stream:
        is_cr2 = stream.read(10)[8:] == b"CR"
    is_thumbnail = bool(spec.get_int_attribute("tiff:subfiletype", 0) & _THUMBNAIL)
    is_smaller = following is not None and 2 * spec.width <= following.width
    colours = spec.get_int_attribute("tiff:PhotometricInterpretation", -1)
    return is_cr2 or is_thumbnail or is_smaller or colours in _RAW_COLOURS


def _layers(specs: Sequence[oiio.ImageSpec]) -> Iterator[ImageLayer]:
    """Yield the layers with R, G and B of flat parts, in the file's order.

    A part's name is the name of its channels that have none.
    """
    for part, spec in enumerate(specs):
        names = () if spec.deep else spec.channelnames
        for layer in dict.fromkeys(name.rpartition(".")[0] for name in names):
            at = {}
            for index, name in enumerate(names):
                before, _, letter = name.rpartition(".")
                if before == layer:
                    at[_LETTERS.get(letter.lower(), letter.lower())] = index
            if all(letter in at for letter in "rgb"):
                name = layer or spec.get_string_attribute("oiio:subimagename")
                yield ImageLayer(name, part, [at[letter] for letter in "rgb"], at.get("a"))


def _rank(layer: ImageLayer) -> int:
    """Rank a layer: 0 for the image, 1 for a name that says nothing, 2 for another quantity."""
    words = {word.lower() for word in _WORD.findall(layer.name)}
    if words & _OTHER_WORDS:
        return 2
    return int(bool(words) and not words & _IMAGE_WORDS)


def _named(path: Path, layers: Sequence[ImageLayer], wanted: str) -> ImageLayer:
    for layer in layers:
        if wanted.casefold() in (layer.name.casefold(), layer.name.rpartition(".")[2].casefold()):
            return layer
    known = ", ".join(layer.name for layer in layers if layer.name)
    advice = f"it has {known}" if known else "it has none with R, G and B"
    raise InputError(f"{path}: has no layer {one_line(wanted)!r}; {advice}")


def pick_channels(spec: oiio.ImageSpec) -> tuple[list[int], int | None]:
    """Choose the first channels as colour, one for grey or three, and alpha."""
    alpha = spec.alpha_channel
    rest = [index for index in range(spec.nchannels) if index != alpha]
    colour = rest[:3] if len(rest) >= 3 else rest[:1] or [0]
    return colour, alpha if alpha >= 0 and alpha not in colour else None


def shown_size(spec: oiio.ImageSpec) -> tuple[int, int]:
    """Height and width of an image once it is upright and its pixels are square."""
    height, width = spec.full_height, spec.full_width
    aspect = spec.get_float_attribute("PixelAspectRatio", 1.0)
    if (
        math.isfinite(aspect)
        and 1 / _MOST_ASPECT <= aspect <= _MOST_ASPECT
        and abs(aspect - 1) > _SAME_ASPECT
    ):
        height, width = (height, round(width * aspect)) if aspect > 1 else (round(height / aspect), width)
    return (width, height) if spec.get_int_attribute("Orientation", 1) >= 5 else (height, width)


def reason(path: Path, message: str) -> str:
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


def is_floating(spec: oiio.ImageSpec) -> bool:
    """Return whether values are half, single or double precision floats."""
    return spec.format.basetype in (oiio.HALF, oiio.FLOAT, oiio.DOUBLE)
