"""Provenance as an XMP packet in PNG and JPEG files, where viewers look for IPTC's digital source type."""

import struct
import zlib
from collections.abc import Mapping
from pathlib import Path
from xml.sax.saxutils import quoteattr

_NAMESPACES = {
    "Iptc4xmpExt": "http://iptc.org/std/Iptc4xmpExt/2008-02-29/",
    "xmp": "http://ns.adobe.com/xap/1.0/",
    "facerf": "urn:facerf:1",
}
# Our metadata's names beside those of the standards; `facerf:…` stays as it is.
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
