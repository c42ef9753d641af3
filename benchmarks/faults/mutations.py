"""Faults of files: of bytes, and of the structure of JSON, text, ZIP, PNG, npy and safetensors."""

import io
import json
import random
import re
import struct
import zipfile
import zlib
from collections.abc import Callable
from typing import Any

Mutation = Callable[[bytes, random.Random], bytes]

_LENGTHS = (1, 2, 4, 8)
_INTEGERS = (0, 1, 2, 7, 127, 128, 255, 256, 32767, 65535, 65536, 2**24, 2**31 - 1, 2**31, 2**32 - 1, 2**63)
_NUMBERS = ("nan", "inf", "-inf", "1e999", "-0", "1e-400", "1e308", "0x10", "1_000", "٣", "", "9" * 400, "-1")
_NUMBERS += ("0", "1", "4097", "1000000000", "99999999999999999999", "0.5", "1e5", "true", "null")
_WORDS = ("\x1b[31m", "\u2028", "\u202e", "\x00", "a\nb", "../../x", "/etc/passwd", "é" * 40, "x" * 5000)
_WORDS += ("{subject}", "<script>", "\x85", "\ufeff", "\ud800", "%s%n", "NaN", "COM1", ".", "", " ")
_RAW = ("1e999", "-1e999", "NaN", "Infinity", "9" * 400, "9" * 5000, "[" * 5000 + "]" * 5000, '{"a":' * 3000)
_TYPES = ("F8_E4M3", "F8_E5M2", "F16", "BF16", "F32", "F64", "I64", "U8", "BOOL", "C64", "I16", "U64", "X9")
_DESCRIPTIONS = ("<f8", ">f4", "|O", "<f2", "|b1", "<c16", "|S9", "<U999999", "<M8[ns]", "|V8", "<f16", "<i1")


def bytes_(data: bytes, draw: random.Random) -> bytes:
    """Change one to four places."""
    changed = bytearray(data or b"\0")
    for _ in range(draw.choice((1, 1, 1, 2, 4))):
        draw.choice(_BYTE_FAULTS)(changed, draw)
    return bytes(changed)


def _place(data: bytearray, draw: random.Random) -> int:
    """A position, as often in the first 512 bytes, where headers are, as in all."""
    end = len(data) if draw.random() < 0.5 else min(len(data), 512)
    return draw.randrange(max(end, 1))


def _flip(data: bytearray, draw: random.Random) -> None:
    if data:
        data[_place(data, draw)] ^= 1 << draw.randrange(8)


def _set(data: bytearray, draw: random.Random) -> None:
    if data:
        data[_place(data, draw)] = draw.choice((0, 1, 9, 10, 32, 90, 127, 128, 255, draw.randrange(256)))


def _integer(data: bytearray, draw: random.Random) -> None:
    length, at = draw.choice(_LENGTHS), _place(data, draw)
    value = draw.choice(_INTEGERS) % 256**length
    data[at : at + length] = value.to_bytes(length, draw.choice(("little", "big")))


def _delete(data: bytearray, draw: random.Random) -> None:
    at = _place(data, draw)
    del data[at : at + draw.choice((1, 2, 4, 16, 200, len(data) // 3))]


def _insert(data: bytearray, draw: random.Random) -> None:
    at, count = _place(data, draw), draw.choice((1, 2, 4, 16, 200))
    data[at:at] = draw.choice((bytes(count), draw.randbytes(count), bytes(data[at : at + count])))


def _repeat(data: bytearray, draw: random.Random) -> None:
    at = _place(data, draw)
    data[at:at] = bytes(data[at : at + draw.choice((1, 8, 64))]) * draw.choice((2, 50, 1000))


def _cut(data: bytearray, draw: random.Random) -> None:
    del data[_place(data, draw) :]


_BYTE_FAULTS = (_flip, _flip, _set, _set, _integer, _integer, _delete, _insert, _repeat, _cut)


def text(data: bytes, draw: random.Random) -> bytes:
    """Replace, remove or repeat numbers, words and lines of a text."""
    words = re.split(r"(\s+|[,;:=\[\]{}()\"'])", data.decode("utf-8", "surrogateescape"))
    for _ in range(draw.choice((1, 1, 2, 5))):
        at = draw.randrange(len(words))
        times = draw.choice((2, 3000))
        words[at] = draw.choice(
            (draw.choice(_NUMBERS), draw.choice(_WORDS), "", words[at][:200] * times, "\n")
        )
    return "".join(words).encode("utf-8", "surrogatepass" if draw.random() < 0.1 else "replace")


def json_(data: bytes, draw: random.Random) -> bytes:
    """Change values, keys and lengths of a JSON document, or of one line of JSON lines."""
    lines = data.decode("utf-8", "replace").split("\n")
    full = [number for number, line in enumerate(lines) if line.strip()]
    try:
        content, whole = json.loads(data), True
    except (ValueError, RecursionError):
        if not full:
            return bytes_(data, draw)
        at, whole = draw.choice(full), False
        try:
            content = json.loads(lines[at])
        except (ValueError, RecursionError):
            return text(data, draw)
    holder = [content]
    raw: list[str] = []
    for _ in range(draw.choice((1, 1, 1, 2, 3))):
        _change(holder, draw, raw)
    try:
        written = json.dumps(holder[0], ensure_ascii=draw.random() < 0.5)
    except (ValueError, RecursionError):  # an integer of more digits than Python writes, or a deep document
        return bytes_(data, draw)
    for number, value in enumerate(raw):
        written = written.replace(f'"@RAW{number}@"', value)
    if draw.random() < 0.05:
        written = re.sub(r'("[^"]*": [^,{}\[\]]+)', r"\1, \1", written, count=1)  # a key twice
    result = written if whole else "\n".join([*lines[:at], written, *lines[at + 1 :]])
    return result.encode("utf-8", "surrogatepass")


def _change(holder: list[Any], draw: random.Random, raw: list[str]) -> None:
    """Replace one value below `holder`, or change its container."""
    places = [(container, key) for container, key in _places(holder)]
    container, key = draw.choice(places)
    old = container[key]
    if draw.random() < 0.15 and container is not holder:
        del container[key]
    elif draw.random() < 0.1 and isinstance(container, dict):
        container[draw.choice(_WORDS)] = container.pop(key)
    elif draw.random() < 0.15 and isinstance(old, list):
        container[key] = old * draw.choice((0, 2, 100)) + old[:1]
    elif draw.random() < 0.2:
        raw.append(draw.choice(_RAW))
        container[key] = f"@RAW{len(raw) - 1}@"
    else:
        small = (None, True, 0, -1, 1, 3, 0.5, 1e300, 2**31, 2**63, 10**30, [], {}, "", [None], {"a": 1})
        container[key] = draw.choice((*small, draw.choice(_WORDS), [old], str(old)[:99], [0.0] * 3))


def _places(value: Any, most: int = 400) -> list[tuple[Any, Any]]:
    found: list[tuple[Any, Any]] = []
    ahead = [value]
    while ahead and len(found) < most:
        container = ahead.pop(0)
        keys = list(container) if isinstance(container, dict) else range(len(container))
        for key in keys:
            found.append((container, key))
            if isinstance(container[key], (dict, list)):
                ahead.append(container[key])
    return found


def png(data: bytes, draw: random.Random) -> bytes:
    """Change, repeat, remove or reorder chunks, with right checksums."""
    if not data.startswith(b"\x89PNG"):
        return bytes_(data, draw)
    chunks, at = [], 8
    while at + 8 <= len(data):
        (length,) = struct.unpack_from(">I", data, at)
        chunks.append((data[at + 4 : at + 8], data[at + 8 : at + 8 + length]))
        at += 12 + length
    chosen = draw.randrange(len(chunks))
    kind, body = chunks[chosen]
    action = draw.random()
    if action < 0.6:
        chunks[chosen] = kind, bytes_(body, draw)
    elif action < 0.75:
        chunks.insert(draw.randrange(len(chunks)), chunks[chosen])
    elif action < 0.9:
        del chunks[chosen]
    else:
        kinds = (b"iCCP", b"tRNS", b"PLTE", b"eXIf", b"iTXt", b"zTXt", b"cHRM", b"gAMA", b"acTL", b"sBIT")
        chunks.insert(1, (draw.choice(kinds), draw.randbytes(draw.choice((0, 1, 30, 300)))))
    body_of = (struct.pack(">I", len(b)) + k + b + struct.pack(">I", zlib.crc32(k + b)) for k, b in chunks)
    return data[:8] + b"".join(body_of)


def zip_(data: bytes, draw: random.Random) -> bytes:
    """Change one member of an archive, its name or its bytes, and write the archive again."""
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            members = {name: archive.read(name) for name in archive.namelist()}
    except Exception:  # an earlier fault broke it as a .zip
        return bytes_(data, draw)
    if not members:
        return bytes_(data, draw)
    name = draw.choice(sorted(members))
    action = draw.random()
    if action < 0.75:
        members[name] = (npy if name.endswith(".npy") else bytes_)(members[name], draw)
    elif action < 0.85:
        del members[name]
    else:
        members[draw.choice(("../x.npy", "/x", "a/b.npy", "\x1b.npy", "x" * 300 + ".npy"))] = members.pop(
            name
        )
    file = io.BytesIO()
    kind = draw.choice((zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED))
    with zipfile.ZipFile(file, "w", kind) as archive:
        for key, content in members.items():
            archive.writestr(zipfile.ZipInfo(key), content, kind)
    return file.getvalue()


def npy(data: bytes, draw: random.Random) -> bytes:
    """Change the header of a .npy as text, with its right length, or its bytes."""
    if not data.startswith(b"\x93NUMPY") or draw.random() < 0.3:
        return bytes_(data, draw)
    (length,) = struct.unpack_from("<H", data, 8)
    header, body = data[10 : 10 + length].decode("latin-1"), data[10 + length :]
    action = draw.random()
    if action < 0.35:
        header = re.sub(r"'descr': '[^']*'", f"'descr': '{draw.choice(_DESCRIPTIONS)}'", header)
    elif action < 0.7:
        shapes = ("()", "(0,)", "(-1,)", "(1, 2, 3)", "(99999999999,)", "(2**3,)", "(None,)", "(1,)" * 9)
        header = re.sub(r"'shape': \([^)]*\)", f"'shape': {draw.choice(shapes)}", header)
    else:
        header = text(header.encode("latin-1"), draw).decode("latin-1")
    raw = header.encode("latin-1", "replace")[:65535]
    return data[:8] + struct.pack("<H", len(raw)) + raw + body


def safetensors(data: bytes, draw: random.Random) -> bytes:
    """Change the JSON header of a safetensors file, also the JSON inside of its metadata."""
    (length,) = struct.unpack_from("<Q", data) if len(data) > 8 else (0,)
    try:
        header = json.loads(data[8 : 8 + length])
    except (ValueError, RecursionError):
        return bytes_(data, draw)
    body, action = data[8 + length :], draw.random()
    names = [name for name in header if name != "__metadata__"]
    if action < 0.25 and names:
        header[draw.choice(names)]["dtype"] = draw.choice(_TYPES)
    elif action < 0.6 and "__metadata__" in header:
        inner = header["__metadata__"]
        key = draw.choice(sorted(inner))
        inner[key] = json_(inner[key].encode(), draw).decode("utf-8", "replace")
    elif action < 0.8:
        raw = json_(data[8 : 8 + length], draw)
        return struct.pack("<Q", len(raw)) + raw + body
    else:
        return bytes_(data, draw)
    raw = json.dumps(header).encode()
    return struct.pack("<Q", len(raw)) + raw + body


def json_inside(data: bytes, draw: random.Random) -> bytes:
    """Change the JSON in a header of another format without changing its length."""
    at = data.find(b'{"format"')
    if at < 0 or draw.random() < 0.4:
        return bytes_(data, draw)
    (length,) = struct.unpack_from("<I", data, at - 4)
    changed = draw.choice((json_, text, bytes_))(data[at : at + length], draw)
    return data[:at] + changed[:length].ljust(length) + data[at + length :]
