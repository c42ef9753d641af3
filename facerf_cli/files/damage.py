"""What a decoder reports badly, found before it starts: names that are no UTF-8, PNG files cut short."""

import struct
import zlib
from pathlib import Path

from facerf_cli.errors import InputError

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
