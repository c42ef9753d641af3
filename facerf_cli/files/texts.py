"""User-supplied text files, read within limits: text, JSON, TOML and lists of lights.

Only regular files are opened, because a pipe or a device could block forever. The module imports nothing
heavy: the journal of a finished folder is read with it.
"""

import codecs
import hashlib
import json
import math
import os
import re
import stat
import tomllib
from pathlib import Path
from typing import Any

from facerf_cli.errors import InputError

LIMIT_BYTES = 64 << 20
_ENDS_IN_NUMBER = re.compile(r"(.*\s)?[-+]?(\d+\.?\d*|\.\d+)(e[-+]?\d+)?", re.IGNORECASE)

Vector = list[float]
ListedLight = tuple[str, Vector]  # name of an image, empty in a list without names


def is_regular(path: Path) -> bool:
    """Return whether a path leads to a regular file; False for names that the system rejects."""
    return regular_size(path) is not None


def regular_size(path: Path) -> int | None:
    """Return the bytes of a regular file; None for anything else, and for names that the system rejects."""
    try:
        state = os.stat(path)
    except (OSError, ValueError):
        return None
    return state.st_size if stat.S_ISREG(state.st_mode) else None


def require_regular(path: Path, advice: str = "check the path") -> None:
    """Raise InputError unless a path leads to a regular file."""
    try:
        mode = os.stat(path).st_mode
    except FileNotFoundError:
        raise InputError(f"{path}: no such file; {advice}") from None
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror or error}); {advice}") from None
    except ValueError:  # a null character
        raise InputError(f"{str(path)!a}: invalid file name; {advice}") from None
    if not stat.S_ISREG(mode):
        kind = "a folder" if stat.S_ISDIR(mode) else "a pipe or a device"
        raise InputError(f"{path}: is {kind}, not a regular file; {advice}")


def read_bytes(path: Path, advice: str) -> bytes:
    """Read a regular file of at most `LIMIT_BYTES`; errors are InputErrors with the advice."""
    require_regular(path, advice)
    try:
        with path.open("rb") as stream:
            content = stream.read(LIMIT_BYTES + 1)
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror or error}); {advice}") from None
    if len(content) > LIMIT_BYTES:
        raise InputError(f"{path}: larger than {LIMIT_BYTES >> 20} MiB; {advice}")
    return content


def text_of(content: bytes, errors: str = "strict") -> str:
    """Decode text in UTF-8, or in UTF-16 with a byte order mark, and remove the mark."""
    is_utf16 = content.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE))
    return content.decode("utf-16" if is_utf16 else "utf-8-sig", errors)


def read_text(path: Path, advice: str) -> str:
    """Read a text file; invalid bytes are replaced."""
    return text_of(read_bytes(path, advice), "replace")


def file_sha256(path: Path) -> str:
    """Return a file's SHA-256 as 64 hex digits."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def parse_json(text: str | bytes) -> Any:
    """Return the value of a JSON text; raises ValueError for anything else, and for NaN and Infinity."""
    try:
        return json.loads(text_of(text) if isinstance(text, bytes) else text, parse_constant=_refuse_constant)
    except RecursionError:
        raise ValueError("nested too deeply") from None


def _refuse_constant(text: str) -> float:
    raise ValueError(f"{text} is not a finite number")


def read_json(path: Path, advice: str) -> Any:
    """Read a JSON file; errors are InputErrors with the advice."""
    content = read_bytes(path, advice)
    try:
        return parse_json(content)
    except ValueError as error:
        raise InputError(f"{path}: not JSON ({error}); {advice}") from None


def read_toml(path: Path, advice: str) -> dict[str, Any]:
    """Read the tables of a TOML file; errors are InputErrors with the advice."""
    content = read_bytes(path, advice)
    try:
        return tomllib.loads(text_of(content))
    except (ValueError, RecursionError) as error:  # also of the decoding
        raise InputError(f"{path}: not TOML ({error}); {advice}") from None


def read_light_list(path: Path) -> list[ListedLight]:
    """Read a list of lights; raises InputError with the first invalid line or entry.

    A text file has lines `name x y z` or `x y z`, like LP files of reflectance transformation imaging, which
    start with the number of lights. A JSON file contains [[x, y, z], ...] or {name: [x, y, z]}, optionally
    under "light_positions".
    """
    text = read_text(path, "write lines `name x y z`")
    try:
        rows = _rows_of_json(text) if path.suffix.lower() == ".json" else _rows_of_text(text)
    except ValueError as error:
        raise InputError(f"{path}: not a list of lights ({error}); write [[x, y, z], ...]") from None
    lights: list[ListedLight] = []
    for where, name, values in rows:
        try:
            x, y, z = values
            vector = [float(x), float(y), float(z)]
        except (ValueError, TypeError):
            raise InputError(f"{path}: {where} is invalid; use `name x y z`") from None
        if not 0 < math.hypot(*vector) < math.inf:
            raise InputError(f"{path}: {where} has no direction; use a finite vector other than 0")
        lights.append((name, vector))
    return lights


def _rows_of_text(text: str) -> list[tuple[str, str, Any]]:
    """Return the line number, name and values of each light."""
    rows: list[tuple[str, str, Any]] = []
    count = None
    for number, line in enumerate(text.splitlines(), 1):
        fields = re.split(r"(?:^|\s)#", line)[0].replace(",", " ").rsplit(maxsplit=3)
        if not rows and len(fields) == 1 and fields[0].isdecimal():
            count = int(fields[0])
        elif fields:
            name = "".join(fields[:-3]).strip()
            has_too_many = _ENDS_IN_NUMBER.fullmatch(name) and not name.isdecimal()
            rows.append((f"line {number}", name, [] if has_too_many else fields[-3:]))
    if count not in (None, len(rows)):
        raise ValueError(f"it states {count} lights and has {len(rows)}")
    return rows


def _rows_of_json(text: str) -> list[tuple[str, str, Any]]:
    content = parse_json(text)
    if isinstance(content, dict):
        content = content.get("light_positions", content)
    if isinstance(content, dict):
        return [(name, name, values) for name, values in content.items()]
    if not isinstance(content, list):
        raise ValueError("neither a list nor an object")
    return [(f"light {number}", "", values) for number, values in enumerate(content)]


def text_of_state(path: Path) -> str:
    """Return text that changes when a file is rewritten."""
    state = path.stat()
    return f"{state.st_size}-{state.st_mtime_ns}"


def is_made_from(path: Path, text: str) -> bool:
    """Tell whether a safetensors file exists whose metadata `of` is the text."""
    from safetensors import SafetensorError, safe_open

    try:
        with safe_open(path, framework="np") as file:
            return bool((file.metadata() or {}).get("of") == text)
    except (SafetensorError, OSError):
        return False
