"""Metadata of image files: headers without pixels, and XMP provenance.

Provenance is written as an XMP packet into PNG, JPEG and TIFF files, where viewers look for IPTC's digital
source type.
"""

import os
import re
import shutil
import struct
import zlib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO
from xml.sax.saxutils import quoteattr

import OpenImageIO as oiio

from facerf_cli._version import __version__
from facerf_cli.errors import InputError
from facerf_cli.files.read import metadata_of, open_image, shown_size
from facerf_cli.files.spaces import is_floating
from facerf_cli.files.workarounds import utf8_path

Attributes = Mapping[str, str | int | float]

# IPTC's digital source types (cv.iptc.org/newscodes/digitalsourcetype): changed by a trained model,
COMPOSITE_SOURCE_TYPE = "http://cv.iptc.org/newscodes/digitalsourcetype/compositeWithTrainedAlgorithmicMedia"

# computed entirely,
COMPUTER_GRAPHICS_SOURCE_TYPE = "http://cv.iptc.org/newscodes/digitalsourcetype/algorithmicMedia"

# and sums of photographs.
_CAPTURES_SOURCE_TYPE = "http://cv.iptc.org/newscodes/digitalsourcetype/compositeCapture"

_PNG_SIGNATURE, _JPEG_START = b"\x89PNG\r\n\x1a\n", b"\xff\xd8"
_TIFF_START, _TIFF_XMP_TAG = b"II*\0", 700
_JPEG_XMP_SIGNATURE = b"http://ns.adobe.com/xap/1.0/\0"  # starts the APP1 segment that contains XMP
_XMP_NAMESPACES = {
    "Iptc4xmpExt": "http://iptc.org/std/Iptc4xmpExt/2008-02-29/",
    "xmp": "http://ns.adobe.com/xap/1.0/",
    "facerf": "urn:facerf:1",
}
# Attributes with another name in XMP.
_XMP_PROPERTIES = {"IPTC:DigitalSourceType": "Iptc4xmpExt:DigitalSourceType", "Software": "xmp:CreatorTool"}

_OF_PLATE = re.compile(
    r"(?!.*(GPS|Note|Comment|Owner|Serial|Unique|Uuid|Photographer|Editor))"
    r"(smpte:(Time|Key)Code|[Ff]ramesPerSecond|DateTime|Make|Model|ExposureTime|FNumber|reelName|Exif:\w+"
    r"|(camera|lens|sensor)\w*|(nominal|effective|entrancePupil|pinhole)\w*|focalLength|focus|aperture|tStop"
    r"|expTime|isoSpeed|shutterAngle|captureRate|imageCounter)"
)
_TUPLES = {"smpte:TimeCode": "timecode", "smpte:KeyCode": "keycode"}


@dataclass(frozen=True)
class Provenance:
    """Origin of a result, for the metadata of every output.

    `face_model` and its licence are `MorphableModel.stamp`; `source_type` is '' for images that are not
    synthetic, such as a cropped photograph.
    """

    input_name: str = ""
    checkpoint_name: str = ""
    face_model: str = ""
    face_model_licence: str = ""
    source_type: str = COMPOSITE_SOURCE_TYPE
    key: str = ""  # of the file of `-o FILE`, so that a later run recognises it

    def attributes(self) -> dict[str, str | int]:
        """Return metadata for a file's header, without empty fields."""
        attributes: dict[str, str | int] = {
            "Software": f"facerf {__version__}",
            "facerf:version": __version__,
            "facerf:synthetic": 1 if self.source_type else "",
            "IPTC:DigitalSourceType": self.source_type,
            "facerf:input": self.input_name,
            "facerf:checkpoint": self.checkpoint_name,
            "facerf:face_model": self.face_model,
            "facerf:face_model_licence": self.face_model_licence,
            "facerf:key": self.key,
        }
        return {name: value for name, value in attributes.items() if value != ""}


def attributes_of_sum(stack: Mapping[str, Any], stack_name: str = "", key: str = "") -> dict[str, Any]:
    """Return metadata for weighted sums of a stack's images, from the stack's metadata.

    Sums of photographs are also marked as synthetic, since their light did not exist.
    """
    default = Provenance(stack_name, source_type=_CAPTURES_SOURCE_TYPE)
    of_stack = {name: value for name, value in stack.items() if name != "facerf:key"}
    return default.attributes() | of_stack | Provenance(source_type="", key=key).attributes()


@dataclass(frozen=True)
class Header:
    """Upright size, number format and metadata."""

    width_px: int
    height_px: int
    is_floating: bool
    bits: int  # per value
    metadata: dict[str, Any]


def read_header(path: Path) -> Header | None:
    """Read the header of the layer that `read_image` reads; return None if it cannot be opened."""
    utf8_path(path)
    if not path.is_file():
        return None
    try:
        with open_image(path) as opened:
            spec = opened.spec
    except InputError:  # not an image, damaged, or pi-heif is missing
        return None
    height, width = shown_size(spec)
    return Header(width, height, is_floating(spec), 8 * spec.format.size(), metadata_of(spec))


def plate_metadata(metadata: Mapping[str, Any]) -> dict[str, Any]:
    """Return the metadata that results keep: how a photo was taken, not where or by whom."""
    return {name: value for name, value in metadata.items() if _OF_PLATE.fullmatch(name)}


def set_attribute(spec: oiio.ImageSpec, name: str, value: Any) -> None:
    """Set an attribute of an image; the type of a tuple depends on its name, or on its numbers."""
    if isinstance(value, tuple):
        of_numbers = f"float[{len(value)}]" if any(isinstance(x, float) for x in value) else "rational"
        spec.attribute(name, oiio.TypeDesc(_TUPLES.get(name, of_numbers)), value)
    else:
        spec.attribute(name, value)


def embed_xmp(path: Path, metadata: Attributes) -> None:
    """Insert an XMP packet into a finished PNG, JPEG or TIFF; other files are unchanged."""
    if path.suffix.lower() not in (".png", ".jpg", ".jpeg", ".tif", ".tiff"):
        return
    packet = xmp_packet(metadata)
    with path.open("r+b") as stream:
        start = stream.read(len(_PNG_SIGNATURE))
        if start.startswith(_TIFF_START):
            _append_to_tiff(stream, packet)
    if start.startswith(_JPEG_START):
        body = _JPEG_XMP_SIGNATURE + packet
        segment = b"\xff\xe1" + struct.pack(">H", len(body) + 2) + body
        at = len(_JPEG_START)
        if start[at : at + 2] == b"\xff\xe0":  # the JFIF segment must stay first
            at += 2 + int.from_bytes(start[at + 2 : at + 4], "big")
        _insert(path, at, segment)
    elif start == _PNG_SIGNATURE:
        body = b"iTXtXML:com.adobe.xmp\0\0\0\0\0" + packet
        segment = struct.pack(">I", len(body) - 4) + body + struct.pack(">I", zlib.crc32(body))
        _insert(path, len(_PNG_SIGNATURE) + 25, segment)  # after the header chunk, whose length is fixed


def _insert(path: Path, at: int, segment: bytes) -> None:
    """Insert bytes into a file without loading it into memory."""
    longer = path.with_name(f"{path.name}.xmp")
    with path.open("rb") as before, longer.open("xb") as after:
        after.write(before.read(at) + segment)
        shutil.copyfileobj(before, after)
    longer.replace(path)


def _append_to_tiff(stream: BinaryIO, packet: bytes) -> None:
    """Append an XMP packet and a directory that points to it to a little-endian TIFF."""
    stream.seek(len(_TIFF_START))
    stream.seek(int.from_bytes(stream.read(4), "little"))
    (count,) = struct.unpack("<H", stream.read(2))
    entries = [stream.read(12) for _ in range(count)]
    following = stream.read(4)  # the offset of the next directory
    kept = [entry for entry in entries if struct.unpack_from("<H", entry)[0] != _TIFF_XMP_TAG]
    end = stream.seek(0, os.SEEK_END)
    place = end + end % 2  # offsets are even
    added = struct.pack("<HHII", _TIFF_XMP_TAG, 1, len(packet), place)
    directory = sorted([*kept, added], key=lambda entry: int(struct.unpack_from("<H", entry)[0]))
    stream.write(bytes(end % 2) + packet + bytes(len(packet) % 2))
    at = stream.tell()
    stream.write(struct.pack("<H", len(directory)) + b"".join(directory) + following)
    stream.seek(len(_TIFF_START))
    stream.write(struct.pack("<I", at))


def xmp_packet(metadata: Attributes) -> bytes:
    """Return an XMP packet with the attributes that have an XMP name."""
    named = {_XMP_PROPERTIES.get(name, name): value for name, value in metadata.items()}
    properties = [
        f"{name}={quoteattr(str(value))}"
        for name, value in named.items()
        if name.split(":")[0] in _XMP_NAMESPACES
    ]
    namespaces = [f'xmlns:{prefix}="{address}"' for prefix, address in _XMP_NAMESPACES.items()]
    return (
        '<?xpacket begin="\ufeff" id="W5M0MpCehiHzreSzNTczkc9d"?><x:xmpmeta xmlns:x="adobe:ns:meta/">'
        '<rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#">'
        f'<rdf:Description rdf:about="" {" ".join([*namespaces, *properties])}/></rdf:RDF></x:xmpmeta>'
        '<?xpacket end="w"?>'
    ).encode()
