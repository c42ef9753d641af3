"""JSON that a user brings: read within bounds, and every entry checked, with one line that says where."""

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
# Names become parts of paths: no separators, nothing hidden, nothing that climbs out of a folder.
_NAME = re.compile(r"[A-Za-z0-9_+@=-][A-Za-z0-9_+@=. -]{0,99}")
_RESERVED = (" ", ".", ".json", ".jsonl")  # ends of names; a dataset has files of its own that end so
_LARGEST, _UNIT_OFF = 1e12, 1e-3


@dataclass(frozen=True)
class Node:
    """A value in a JSON document, and where it stands there."""

    where: str  # the file, and the way to the value
    value: Any

    def wrong(self, wanted: str) -> InputError:
        """The error that says what should stand here."""
        text = json.dumps(self.value, default=str)
        shown = text if len(text) <= 60 else text[:57] + "..."
        return InputError(f"{self.where} is {shown}; {wanted} is needed")

    def __getitem__(self, key: str) -> "Node":
        found = self.get(key)
        if found is None:
            raise InputError(f"{self.where} has no {key!r}")
        return found

    def get(self, key: str) -> "Node | None":
        """An object's entry, or None where it has none of that key."""
        table = self.table()
        return Node(f"{self.where}: {key}", table[key]) if key in table else None

    def text(self) -> str:
        """A string."""
        if not isinstance(self.value, str):
            raise self.wrong("a text")
        return self.value

    def name(self) -> str:
        """A string that can stand in a file's name, such as a subject's or a camera's."""
        if not is_name(self.text()):
            raise self.wrong("a name of letters, digits, - and _")
        return self.text()

    def whole(self, low: int, high: int) -> int:
        """A whole number from `low` to `high`."""
        if type(self.value) is not int or not low <= self.value <= high:
            raise self.wrong(f"a whole number from {low} to {high}")
        return self.value

    def array(self, *shape: int) -> np.ndarray:
        """Finite numbers of that shape, float64; without a shape, one number."""
        kind = " x ".join(map(str, shape)) + " finite numbers" if shape else "a finite number"
        try:
            array = np.array(self.value)
        except ValueError:
            raise self.wrong(kind) from None
        if array.shape != shape or array.dtype.kind not in "if" or not (np.abs(array) < _LARGEST).all():
            raise self.wrong(kind)
        return array.astype(np.float64)

    def unit(self) -> np.ndarray:
        """A direction [3] of length 1."""
        direction = self.array(3)
        if not abs(np.linalg.norm(direction) - 1) < _UNIT_OFF:
            raise self.wrong("a vector of length 1")
        return direction / np.linalg.norm(direction)

    def table(self) -> dict[str, Any]:
        """An object as it stands."""
        if not isinstance(self.value, dict):
            raise self.wrong("an object { }")
        return self.value

    def nulls(self) -> "Iterator[Node]":
        """Whatever is null in it, at any depth, in order."""
        ahead = [self]  # not by recursion: documents may be deep
        while ahead:
            node = ahead.pop()
            if node.value is None:
                yield node
            elif isinstance(node.value, dict):
                ahead += [Node(f"{node.where}: {key}", entry) for key, entry in node.value.items()][::-1]
            elif isinstance(node.value, list):
                ahead += [Node(f"{node.where}[{at}]", entry) for at, entry in enumerate(node.value)][::-1]

    def items(self, most: int) -> "list[Node]":
        """A list's entries, `most` of them or fewer."""
        if not isinstance(self.value, list):
            raise self.wrong("a list [ ]")
        if len(self.value) > most:
            raise InputError(f"{self.where} has {len(self.value)} entries; {most} are the most")
        return [Node(f"{self.where}[{index}]", entry) for index, entry in enumerate(self.value)]

    def entries(self, most: int) -> "dict[str, Node]":
        """An object's entries by key, each key a `name`, `most` of them or fewer."""
        if len(self.table()) > most:
            raise InputError(f"{self.where} has {len(self.value)} entries; {most} are the most")
        return {
            Node(f"{self.where}: a key", key).name(): Node(f"{self.where}: {key}", entry)
            for key, entry in self.value.items()
        }


def is_name(text: str) -> bool:
    """Whether a text can stand in a file's name, as a subject's, a camera's or a light's id."""
    return bool(_NAME.fullmatch(text)) and not text.endswith(_RESERVED)


def read_document(path: Path, missing: str) -> Node:
    """The JSON document in a file; `missing` says what to do where there is none."""
    try:
        if not stat.S_ISREG(path.stat().st_mode):
            raise InputError(f"{path}: is no file")
        with path.open("rb") as stream:
            content = stream.read(_LIMIT_BYTES + 1)
    except FileNotFoundError:
        raise InputError(f"{path}: no such file; {missing}") from None
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror or error})") from None
    if len(content) > _LIMIT_BYTES:
        raise InputError(f"{path}: more than {_LIMIT_BYTES >> 20} MiB are too many for a description")
    try:
        return Node(str(path), _parsed(content.decode("utf-8")))
    except UnicodeDecodeError:
        raise InputError(f"{path}: not JSON (it is no text in UTF-8)") from None
    except (ValueError, RecursionError) as error:
        raise InputError(f"{path}: not JSON ({error})") from None


def _parsed(text: str) -> Any:
    return json.loads(text, parse_constant=_no_number, parse_float=_finite, object_pairs_hook=_each_key_once)


def _each_key_once(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    table = dict(pairs)
    if len(table) < len(pairs):
        keys = [key for key, _ in pairs]
        raise ValueError(f"{next(key for key in keys if keys.count(key) > 1)!r} stands twice in an object")
    return table


def _no_number(text: str) -> float:
    raise ValueError(f"{text} is no finite number")


def _finite(text: str) -> float:
    number = float(text)
    return number if math.isfinite(number) else _no_number(text)


def write_document(path: Path, content: Mapping[str, Any]) -> None:
    """Write JSON for people and programs, whole or not at all; NaN is a ValueError.

    Halves of surrogate pairs, which are no UTF-8, stay the escapes that they can only have been.
    """
    text = json.dumps(content, allow_nan=False, ensure_ascii=False, indent=1)
    with atomic_path(path) as temporary:
        temporary.write_text(text + "\n", encoding="utf-8", errors="backslashreplace")


def digest(content: bytes) -> str:
    """What tells contents apart in a file's name or a record: 16 digits of their SHA-256."""
    return hashlib.sha256(content).hexdigest()[:16]


def unique_ids(nodes: list[Node]) -> list[str]:
    """The ids of objects in a list, each a name and none of them twice."""
    ids = [node["id"].name() for node in nodes]
    seen: set[str] = set()
    for node, name in zip(nodes, ids, strict=True):
        if name in seen:
            raise node["id"].wrong("an id that no other entry has")
        seen.add(name)
    return ids
