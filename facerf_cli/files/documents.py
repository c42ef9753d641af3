"""JSON documents: read within limits and checked entry by entry, and written as strict JSON.

An error names the file and the path to the entry, as in `stage.json: lights[2]: id`.
"""

import hashlib
import json
import math
import re
import stat
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from facerf_cli.errors import InputError
from facerf_cli.files.atomic import atomic_path

_LIMIT_BYTES = 64 << 20
# Names become parts of paths: no separators, no hidden files, no way out of a folder.
_NAME = re.compile(r"[A-Za-z0-9_+@=-][A-Za-z0-9_+@=. -]{0,99}")
_RESERVED_ENDS = (" ", ".", ".json", ".jsonl")  # a dataset's own files end in the last two
_LARGEST = 1e12  # magnitude of a number; keeps products of two finite
_UNIT_TOLERANCE = 1e-3  # a direction's length may differ from 1 by this
_SHOWN = 60  # characters of a wrong value that an error quotes


def read_document(path: Path, missing: str) -> "Node":
    """Read a JSON document; `missing` says what to do if the file does not exist."""
    try:
        if not stat.S_ISREG(path.stat().st_mode):
            raise InputError(f"{path}: is no file; give a JSON file")
        with path.open("rb") as stream:
            content = stream.read(_LIMIT_BYTES + 1)
    except FileNotFoundError:
        raise InputError(f"{path}: no such file; {missing}") from None
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror or error})") from None
    if len(content) > _LIMIT_BYTES:
        raise InputError(f"{path}: larger than {_LIMIT_BYTES >> 20} MiB; give a JSON file below that size")
    try:
        return Node(str(path), _parsed(content.decode("utf-8")))
    except UnicodeDecodeError:
        raise InputError(f"{path}: not JSON (the text is not UTF-8)") from None
    except (ValueError, RecursionError) as error:
        raise InputError(f"{path}: not JSON ({error})") from None


def write_document(path: Path, content: Mapping[str, Any]) -> None:
    """Write an indented JSON file atomically; NaN or infinity is a ValueError."""
    with atomic_path(path) as temporary:
        temporary.write_text(json_text(content, indent=1) + "\n", encoding="utf-8")


def json_text(value: Any, indent: int | None = None) -> str:
    """Strict JSON in one line, or indented; NaN or infinity is a ValueError.

    Unpaired surrogates, which UTF-8 cannot encode, are written as escapes. `logs.json_line` is the lenient
    form for rows of logs and reports: it accepts paths and arrays, and writes NaN as null.
    """
    text = json.dumps(value, allow_nan=False, ensure_ascii=False, indent=indent)
    return text.encode(errors="backslashreplace").decode()


def digest(content: bytes) -> str:
    """Identify contents, in a file's name or a record, by 16 hex digits of their SHA-256."""
    return hashlib.sha256(content).hexdigest()[:16]


def is_name(text: str) -> bool:
    """Return whether a text can be part of a file's name, as the id of a subject, a camera or a light."""
    return bool(_NAME.fullmatch(text)) and not text.endswith(_RESERVED_ENDS)


@dataclass(frozen=True)
class Node:
    """A value in a JSON document and its path there; each method checks a type or raises an InputError."""

    where: str  # the file, and the path to the value
    value: Any

    def wrong(self, wanted: str) -> InputError:
        """Return the error that says what is wanted instead of this value."""
        text = json.dumps(self.value, default=str)
        shown = text if len(text) <= _SHOWN else text[: _SHOWN - 3] + "..."
        return InputError(f"{self.where} is {shown}; {wanted} is needed")

    def __getitem__(self, key: str) -> "Node":
        found = self.get(key)
        if found is None:
            raise InputError(f"{self.where} has no {key!r}")
        return found

    def get(self, key: str) -> "Node | None":
        """Return an object's entry, or None if the key is missing."""
        table = self.table()
        return Node(f"{self.where}: {key}", table[key]) if key in table else None

    def text(self) -> str:
        """Return a string."""
        if not isinstance(self.value, str):
            raise self.wrong("a string")
        return self.value

    def name(self) -> str:
        """Return a string that can be part of a file's name, such as a subject's or a camera's id."""
        if not is_name(self.text()):
            raise self.wrong("a name of letters, digits, - and _")
        return self.text()

    def whole(self, low: int, high: int) -> int:
        """Return an integer from `low` to `high`."""
        if type(self.value) is not int or not low <= self.value <= high:
            raise self.wrong(f"a whole number from {low} to {high}")
        return self.value

    def array(self, *shape: int) -> np.ndarray:
        """Return finite numbers of this shape as float64; without a shape, one number."""
        kind = " x ".join(map(str, shape)) + " finite numbers" if shape else "a finite number"
        try:
            array = np.array(self.value)
        except ValueError:
            raise self.wrong(kind) from None
        if array.shape != shape or array.dtype.kind not in "if" or not (np.abs(array) < _LARGEST).all():
            raise self.wrong(kind)
        return array.astype(np.float64)

    def unit(self) -> np.ndarray:
        """Return a direction [3] of length 1."""
        direction = self.array(3)
        if not abs(np.linalg.norm(direction) - 1) < _UNIT_TOLERANCE:
            raise self.wrong("a vector of length 1")
        return direction / np.linalg.norm(direction)

    def table(self) -> dict[str, Any]:
        """Return an object's entries unchecked."""
        if not isinstance(self.value, dict):
            raise self.wrong("an object { }")
        return self.value

    def nulls(self) -> "Iterator[Node]":
        """Yield every null at any depth, in the document's order."""
        ahead = [self]  # a stack instead of recursion: documents may be deep
        while ahead:
            node = ahead.pop()
            if node.value is None:
                yield node
            elif isinstance(node.value, dict):
                ahead += [Node(f"{node.where}: {key}", entry) for key, entry in node.value.items()][::-1]
            elif isinstance(node.value, list):
                ahead += [Node(f"{node.where}[{at}]", entry) for at, entry in enumerate(node.value)][::-1]

    def items(self, most: int) -> "list[Node]":
        """Return a list's entries, at most `most`."""
        if not isinstance(self.value, list):
            raise self.wrong("a list [ ]")
        if len(self.value) > most:
            raise InputError(f"{self.where} has {len(self.value)} entries; {most} are the most")
        return [Node(f"{self.where}[{index}]", entry) for index, entry in enumerate(self.value)]

    def entries(self, most: int) -> "dict[str, Node]":
        """Return an object's entries by key, at most `most`; each key is checked to be a `name`."""
        if len(self.table()) > most:
            raise InputError(f"{self.where} has {len(self.value)} entries; {most} are the most")
        return {
            Node(f"{self.where}: a key", key).name(): Node(f"{self.where}: {key}", entry)
            for key, entry in self.value.items()
        }


def unique_ids(nodes: list[Node]) -> list[str]:
    """Return the ids of a list's objects; each is a name and occurs once."""
    ids = [node["id"].name() for node in nodes]
    seen: set[str] = set()
    for node, name in zip(nodes, ids, strict=True):
        if name in seen:
            raise node["id"].wrong("an id that no other entry has")
        seen.add(name)
    return ids


def _parsed(text: str) -> Any:
    return json.loads(text, parse_constant=_not_finite, parse_float=_finite, object_pairs_hook=_unique_keys)


def _unique_keys(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    table = dict(pairs)
    if len(table) < len(pairs):
        keys = [key for key, _ in pairs]
        raise ValueError(f"{next(key for key in keys if keys.count(key) > 1)!r} occurs twice in an object")
    return table


def _not_finite(text: str) -> float:
    raise ValueError(f"{text} is not a finite number")


def _finite(text: str) -> float:
    number = float(text)
    return number if math.isfinite(number) else _not_finite(text)
