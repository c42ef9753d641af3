"""JSON text of unknown origin, read within limits: bytes, depth, values and the size of numbers.

A key that occurs twice in an object and a number that is not finite are errors. The module imports nothing
heavy, since the index of a finished folder is read with it.
"""

import json
import math
import stat
from collections import Counter
from pathlib import Path
from typing import Any

from facerf_cli.errors import InputError

LIMIT_BYTES = 64 << 20  # of a document
_MOST_VALUES = 4_000_000  # takes about half a gigabyte
_MOST_DEPTH = 64
_LARGEST = 1 << 63  # magnitude of an integer; a longer one overflows where it meets an array
_OPENING = (",", "[", "{")  # there are at most as many values as these, and one


def parse_json(text: str | bytes) -> Any:
    """Return the value of a JSON text in UTF-8; raises ValueError for anything else and beyond the limits."""
    text = text.decode() if isinstance(text, bytes) else text
    if sum(map(text.count, _OPENING)) >= _MOST_VALUES:
        raise ValueError(f"more than {_MOST_VALUES} values")
    try:
        value = json.loads(text, parse_constant=_not_finite, object_pairs_hook=_unique_keys)
    except RecursionError:
        raise ValueError("nested too deeply") from None
    _check(value)
    return value


def read_json(path: Path, missing: str, limit_bytes: int = LIMIT_BYTES) -> Any:
    """Read a JSON file; `missing` says what to do if the file does not exist, or is none of ours."""
    try:
        if not stat.S_ISREG(path.stat().st_mode):
            raise InputError(f"{path}: is no file; give a JSON file")
        with path.open("rb") as stream:
            content = stream.read(limit_bytes + 1)
    except FileNotFoundError:
        raise InputError(f"{path}: no such file; {missing}") from None
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror or error})") from None
    if len(content) > limit_bytes:
        raise InputError(f"{path}: larger than {limit_bytes >> 20} MiB; {missing}")
    try:
        return parse_json(content)
    except ValueError as error:
        raise InputError(f"{path}: not JSON ({error}); {missing}") from None


def _check(value: Any) -> None:
    """Raise ValueError for a deep value or a number that is too large, a level of the document at a time."""
    level = [value]
    for _ in range(_MOST_DEPTH):
        if not all(_fits(entry) for entry in level if isinstance(entry, int | float)):
            raise ValueError("a number in it is too large")
        level = [
            entry
            for parent in level
            if isinstance(parent, dict | list)
            for entry in (parent.values() if isinstance(parent, dict) else parent)
        ]
        if not level:
            return
    raise ValueError(f"nested more than {_MOST_DEPTH} deep")


def _fits(number: int | float) -> bool:
    return abs(number) < _LARGEST if isinstance(number, int) else math.isfinite(number)


def _unique_keys(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    table = dict(pairs)
    if len(table) < len(pairs):
        twice = Counter(key for key, _ in pairs).most_common(1)[0][0]
        raise ValueError(f"{twice[:60]!r} occurs twice in an object")
    return table


def _not_finite(text: str) -> float:
    raise ValueError(f"{text} is not a finite number")
