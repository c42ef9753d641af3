"""What a decoder reports badly, found before it starts: names that are no UTF-8, PNG files cut short.

What a picture's header says, without its pixels: its size, kind of numbers and colour space.

Provenance as an XMP packet in PNG and JPEG files, where viewers look for IPTC's digital source type.

Pictures on disk: any encoding in, scene-linear float32 Rec.709 inside; EXR and display pictures out.
"""

import logging
import re
import struct
import zlib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal
from xml.sax.saxutils import quoteattr

import numpy as np
import OpenImageIO as oiio

from facerf_cli.colour import (
    ADOBE_RGB,
    DISPLAY_P3,
    LINEAR,
    REC709_CHROMATICITIES,
    REC2020,
    SRGB,
    ColourSpace,
    auto_exposure_ev,
    find_space,
    in_blocks,
    linear_space,
    linear_to_srgb,
    named_space,
    to_linear_rec709,
)
from facerf_cli.errors import FacerfError, InputError, UsageError
from facerf_cli.files.atomic import atomic_path
from facerf_cli.logs import LOGGER_NAME, one_line

_PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"


def utf8_path(path: Path) -> str:
    """The path as OpenImageIO takes it: an InputError where it is not UTF-8, as names on disk may be."""
    try:
        path.as_posix().encode()
    except UnicodeEncodeError:
        raise InputError(
            f"{str(path)!a}: the name is not UTF-8; rename the file, or the folder that it is in"
        ) from None
    return str(path)


def require_whole_png(path: Path) -> None:
    """Walk a PNG file's chunks to its last and check their sums; a file of another kind passes."""
    with path.open("rb") as stream:
        if stream.read(len(_PNG_SIGNATURE)) != _PNG_SIGNATURE:
            return
        kind = b""
        while kind != b"IEND":
            head = stream.read(8)
            length, kind = struct.unpack(">I4s", head) if len(head) == 8 else (0, b"")
            body, checksum = stream.read(length), stream.read(4)
            if len(body) != length or len(checksum) != 4:
                raise InputError(f"{path}: damaged or cut short: the PNG file ends too early")
            if zlib.crc32(kind + body) != int.from_bytes(checksum, "big"):
                raise InputError(f"{path}: damaged: a checksum of the PNG file is wrong")


_ICC_SPACES = {"display p3": DISPLAY_P3, "adobe rgb": ADOBE_RGB, "2020": REC2020, "srgb": SRGB}
log = logging.getLogger(LOGGER_NAME)


@dataclass(frozen=True)
class Header:
    """A picture's size upright, and what its values are."""

    width_px: int
    height_px: int
    is_floating: bool
    bits: int  # of a value
    space: ColourSpace  # what the file says; of one that says nothing what is usual: linear, or sRGB
    metadata: dict[str, Any]


def read_header(path: Path) -> Header | None:
    """The header of a picture's first part; None where it is no picture that can be read."""
    stream = oiio.ImageInput.open(utf8_path(path)) if path.is_file() else None
    if stream is None:
        oiio.geterror()  # or it prints its own words at exit
        return None
    spec = stream.spec()
    stream.close()
    width, height = spec.full_width, spec.full_height
    if spec.get_int_attribute("Orientation", 1) >= 5:  # turned by a quarter
        width, height = height, width
    floating, bits = is_floating(spec), 8 * spec.format.size()
    return Header(width, height, floating, bits, space_of_file(path, spec), metadata_of(spec))


def metadata_of(spec: oiio.ImageSpec) -> dict[str, Any]:
    """The plain attributes of a picture that is turned upright."""
    plain = (str, int, float, tuple)
    attributes = {entry.name: entry.value for entry in spec.extra_attribs if isinstance(entry.value, plain)}
    attributes.pop("Orientation", None)  # applied
    return attributes


def space_of_file(path: Path, spec: oiio.ImageSpec) -> ColourSpace:
    """What the file says of its colours; else floats are linear Rec.709 and integers sRGB."""
    default = LINEAR if is_floating(spec) else SRGB
    profile = spec.get_string_attribute("ICCProfile:profile_description")
    name = profile or spec.get_string_attribute("oiio:ColorSpace")
    if profile:
        named = next((space for part, space in _ICC_SPACES.items() if part in profile.lower()), None)
    elif name in ("", "Rec709"):  # the latter is OpenImageIO's word for every PNM file, whatever made it
        named = default
    else:
        named = find_space(name)
    if named is None:
        log.warning("%s: unknown colour space '%s', taken for %s", path, name, default.name)
        named = default
    chromaticities = spec.getattribute("chromaticities", oiio.TypeDesc("float[8]"))
    if not chromaticities or not named.is_linear:
        return named
    by_primaries = linear_space(chromaticities)
    if by_primaries is None:
        log.warning("%s: primaries of no colours that can be, taken for those of %s", path, named.name)
    return named if by_primaries in (None, LINEAR) else by_primaries


def is_floating(spec: oiio.ImageSpec) -> bool:
    """Whether values are of half, single or double precision."""
    return spec.format.basetype in (oiio.HALF, oiio.FLOAT, oiio.DOUBLE)


_NAMESPACES = {
    "Iptc4xmpExt": "http://iptc.org/std/Iptc4xmpExt/2008-02-29/",
    "xmp": "http://ns.adobe.com/xap/1.0/",
    "facerf": "urn:facerf:1",
}
_JPEG_START = b"\xff\xd8"
_PROPERTIES = {"IPTC:DigitalSourceType": "Iptc4xmpExt:DigitalSourceType", "Software": "xmp:CreatorTool"}
_JPEG_START, _PNG_SIGNATURE = b"\xff\xd8", b"\x89PNG\r\n\x1a\n"
_JPEG_SIGNATURE = b"http://ns.adobe.com/xap/1.0/\0"


def embed_xmp(path: Path, metadata: Mapping[str, str | int | float]) -> None:
    """Insert the metadata that has a place in XMP into a finished PNG or JPEG; others stay as they are."""
    data = path.read_bytes() if path.suffix.lower() in (".png", ".jpg", ".jpeg") else b""
    packet = xmp_packet(metadata)
    if data.startswith(_JPEG_START):
        body = _JPEG_SIGNATURE + packet
        segment = b"\xff\xe1" + struct.pack(">H", len(body) + 2) + body
        at = len(_JPEG_START)
        if data[at : at + 2] == b"\xff\xe0":  # JFIF's own segment stays first
            at += 2 + int.from_bytes(data[at + 2 : at + 4], "big")
    elif data.startswith(_PNG_SIGNATURE):
        body = b"iTXtXML:com.adobe.xmp\0\0\0\0\0" + packet
        segment = struct.pack(">I", len(body) - 4) + body + struct.pack(">I", zlib.crc32(body))
        at = len(_PNG_SIGNATURE) + 25  # after the header chunk, whose length is fixed
    else:
        return
    path.write_bytes(data[:at] + segment + data[at:])


def xmp_packet(metadata: Mapping[str, str | int | float]) -> bytes:
    """The packet as XMP's standard frames it."""
    named = {_PROPERTIES.get(name, name): value for name, value in metadata.items()}
    properties = [
        f"{name}={quoteattr(str(value))}"
        for name, value in named.items()
        if name.split(":")[0] in _NAMESPACES
    ]
    namespaces = [f'xmlns:{prefix}="{address}"' for prefix, address in _NAMESPACES.items()]
    return (
        '<?xpacket begin="\ufeff" id="W5M0MpCehiHzreSzNTczkc9d"?><x:xmpmeta xmlns:x="adobe:ns:meta/">'
        '<rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#">'
        f'<rdf:Description rdf:about="" {" ".join([*namespaces, *properties])}/></rdf:RDF></x:xmpmeta>'
        '<?xpacket end="w"?>'
    ).encode()


PHOTO_LIMIT_PX = 64_000_000
ENVMAP_LIMIT_PX = 134_300_000  # 16k x 8k
HALF_MAX = 65504.0
JPEG_QUALITY = 95
# Layers whose values are places, not light, keep full floats: half a float is half a millimetre at a metre.
_LAYER_CHANNELS = {"normal": ("XYZ", "half"), "position": ("XYZ", "float"), "uv": ("UV", "float")}

Attributes = Mapping[str, str | int | float]


@dataclass(frozen=True)
class LinearImage:
    """A picture in scene-linear Rec.709, upright, its colour not multiplied by its alpha."""

    pixels: np.ndarray  # [H, W, 3] float32
    alpha: np.ndarray | None = None  # [H, W] float32
    colourspace_name: str = LINEAR.name  # what the file's values were taken for
    metadata: dict[str, Any] = field(default_factory=dict)


def read_image(
    path: Path | str,
    colourspace: str | None = None,
    limit_px: int = PHOTO_LIMIT_PX,
    non_finite: Literal["error", "zero"] = "error",
) -> LinearImage:
    """Read a picture of any supported format; `colourspace` overrides what the file says of itself.

    The size is checked before anything is decoded. NaN and infinite values are an error, or, with "zero",
    set to 0 with a warning that counts them.
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
    """All channels [H, W, C] of the first part as float32, integers scaled to 0..1."""
    if path.is_dir():
        raise InputError(f"{path}: is a folder, not a picture")
    if not path.is_file() or not path.stat().st_size:
        raise InputError(f"{path}: {'the file is empty' if path.is_file() else 'no such file'}")
    require_whole_png(path)
    settings = oiio.ImageSpec()
    settings.attribute("oiio:UnassociatedAlpha", 1)
    stream = oiio.ImageInput.open(utf8_path(path), settings)
    if stream is None:
        advice = f"save it anew as EXR, PNG or JPEG ({_reason(path, oiio.geterror())})"
        raise InputError(f"{path}: not a picture that can be read; {advice}")
    try:
        spec = stream.spec()
        size_px = max(spec.width * spec.height, spec.full_width * spec.full_height)
        if size_px > limit_px:
            raise InputError(
                f"{path}: {spec.width} x {spec.height} pixels; at most {limit_px / 1e6:.0f} megapixels are "
                "read, make it smaller first"
            )
        values = stream.read_image(0, 0, 0, spec.nchannels, oiio.FLOAT)
        complaint = _reason(path, stream.geterror())
    finally:
        stream.close()
    if values is None or "premature end" in complaint.lower():  # a JPEG cut short decodes to grey
        raise InputError(f"{path}: damaged or cut short; copy it anew ({complaint or 'no pixels in it'})")
    if complaint:
        log.warning("%s: %s", path, complaint)
    return np.asarray(values, np.float32).reshape(spec.height, spec.width, spec.nchannels), spec


def _reason(path: Path, complaint: str) -> str:
    """The first line of OpenImageIO's complaint, without the path that our line begins with."""
    line = (complaint.strip().splitlines() or [""])[0]
    line = re.sub(r' \("?' + re.escape(str(path)) + r'"?\)', "", line).replace(f'"{path}"', "it")
    return one_line(re.sub(r"\bEXR_ERR_\w+ |: magic 0x.*| Is it a file format .*", "", line))


def _pick_channels(names: list[str], alpha_channel: int) -> tuple[list[int], int | None]:
    """Indices of colour (one for grey, else three) and alpha: RGB, a layer's RGB, or what comes first."""
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
    """EXR's data window pasted into its display window; zero where the file holds nothing."""
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
    """[H, W, C] turned and mirrored as EXIF's orientation 1..8 asks."""
    if orientation >= 5:
        values = values.swapaxes(0, 1)
    flip_rows, flip_columns = orientation in (3, 4, 7, 8), orientation in (2, 3, 6, 7)
    return values[:: -1 if flip_rows else 1, :: -1 if flip_columns else 1]


def _finite(path: Path, values: np.ndarray, non_finite: str) -> np.ndarray:
    bad = ~np.isfinite(values)
    if not bad.any():
        return values
    count = int(bad.any(-1).sum())
    if non_finite == "error":
        total = bad.shape[0] * bad.shape[1]
        raise InputError(f"{path}: {count} of {total} pixels are NaN or infinite; mend them first")
    log.warning("%s: %d pixels are NaN or infinite; their values are set to 0", path, count)
    return np.where(bad, np.float32(0), values)


def write_exr(
    path: Path,
    pixels: np.ndarray,
    alpha: np.ndarray | None = None,
    layers: Mapping[str, np.ndarray] | None = None,
    metadata: Attributes | None = None,
) -> int:
    """Write scene-linear Rec.709 [H, W, 3] as half floats, never clipped; give how many were out of range.

    The colour comes unmultiplied and is multiplied by alpha [H, W] as EXR wants it. `layers` are [H, W] or
    [H, W, C]: normal.X/Y/Z in half, position.X/Y/Z and uv.U/V in float, others by R, G, B in half. Values
    beyond half's range (65504) are set to it, with a warning.
    """
    channels = list(_exr_channels(pixels, alpha, layers or {}))
    names, kinds, _ = zip(*channels, strict=True)
    data = np.empty((*pixels.shape[:2], len(channels)), np.float32)
    bad = count = 0
    for index, (_, kind, values) in enumerate(channels):  # one at a time: all of a large photo are gigabytes
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
    spec.attribute("DateTime", "")  # or OpenImageIO writes the hour, and no two runs give the same bytes
    spec.attribute("chromaticities", oiio.TypeDesc("float[8]"), REC709_CHROMATICITIES)
    _write(path, spec, data, metadata)
    return count


def _exr_channels(
    pixels: np.ndarray, alpha: np.ndarray | None, layers: Mapping[str, np.ndarray]
) -> Iterator[tuple[str, str, np.ndarray]]:
    """Name, kind of number and values [H, W] of each channel."""
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
    """Write linear Rec.709 [H, W, 3] as an 8-bit sRGB PNG or JPEG, by the suffix; give the exposure in EV.

    "auto" is `colour.auto_exposure_ev` over what alpha [H, W] covers. PNG keeps alpha beside the unmultiplied
    colour; JPEG has none, and shows the picture over black.
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
    for name, value in (metadata or {}).items():
        spec.attribute(name, value)
    with atomic_path(path) as temporary:
        stream = oiio.ImageOutput.create(utf8_path(temporary))
        if stream is None:
            oiio.geterror()  # or it prints its own words at exit
            raise UsageError(f"{path}: no picture format has this suffix; use .exr, .png or .jpg")
        written = stream.open(str(temporary), spec) and stream.write_image(np.ascontiguousarray(data))
        complaint = stream.geterror()
        if not (stream.close() and written):
            raise FacerfError(f"{path}: cannot write: {one_line(complaint or stream.geterror())}")
        embed_xmp(temporary, metadata or {})
