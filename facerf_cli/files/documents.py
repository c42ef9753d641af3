"""JSON documents and TOML rigs: pydantic validates them; JSON is written strictly.

An error is one line with the file and the path to the entry, as in `stage.json: lights[2]: id is 3; ...`.
Import this module where a document is read alone: pydantic takes a tenth of a second.
"""

import hashlib
import json
import re
import reprlib
from collections.abc import Mapping
from functools import cache, partial
from pathlib import Path
from typing import Annotated, Any, TypeVar, cast

import numpy as np
from pydantic import (
    AfterValidator,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    PlainValidator,
    TypeAdapter,
    ValidationError,
)
from pydantic_core import ErrorDetails

from facerf_cli.errors import InputError
from facerf_cli.files.atomic import atomic_path
from facerf_cli.files.texts import read_json, read_toml

# Names become parts of paths: no separators, no hidden files, no way out of a folder.
_NAME = re.compile(r"[A-Za-z0-9_+@=-][A-Za-z0-9_+@=. -]{0,99}")
_RESERVED_ENDS = (" ", ".", ".json", ".jsonl")  # a dataset's own files end in the last two
MOST_RIG_LIGHTS = 32
_LARGEST = 1e12  # magnitude of a number; keeps products of two finite
_UNIT_TOLERANCE = 1e-3  # a direction's length may differ from 1 by this
_AN_OBJECT = "an object { } is needed"
_WANTED = {"model_type": _AN_OBJECT, "dict_type": _AN_OBJECT, "list_type": "a list [ ] is needed"}

Kind = TypeVar("Kind")


class Document(BaseModel):
    """An object of a document; further keys are ignored, and no value is converted to another type."""

    model_config = ConfigDict(strict=True, frozen=True, allow_inf_nan=False, protected_namespaces=())


def read_document(path: Path, kind: type[Kind], missing: str) -> Kind:
    """Read a JSON document of a model or another type; `missing` says what to do without the file."""
    return checked(kind, read_json(path, missing), str(path))


def checked(kind: type[Kind], value: Any, where: str) -> Kind:
    """Return a parsed value as a type; an InputError names `where` it stands and its first wrong entry."""
    try:
        return cast(Kind, _adapter(cast(Any, kind)).validate_python(value))
    except ValidationError as error:
        first, *others = error.errors(include_url=False)
        text = _said(first, where) + (f" (and {len(others)} more)" if others else "")
        raise InputError(text.replace("\n", " ")) from None


@cache  # pydantic compiles it
def _adapter(kind: Any) -> TypeAdapter[Any]:
    return TypeAdapter(kind)


def _said(error: ErrorDetails, where: str) -> str:
    """Describe an error of pydantic by the path to its entry."""
    kind, value, path = error["type"], error["input"], error["loc"]
    for part in path[:-1] if kind == "missing" else path:
        where += f"[{part}]" if isinstance(part, int) else f": {part}"
    if kind == "missing":
        return f"{where} has no {path[-1]!r}; add it"
    if value is None:
        return f"{where} is null; fill it in"
    said = error["msg"].removeprefix("Value error, ")
    wanted = _WANTED.get(kind, said[:1].lower() + said[1:])
    if kind == "value_error" and isinstance(value, dict):  # of several entries at once
        return f"{where}: {said}"
    try:
        return f"{where} is {reprlib.repr(value)}; {wanted}"
    except ValueError:  # a number of thousands of digits
        return f"{where} is too large; {wanted}"


def read_rig(path: Path) -> dict[str, dict[str, str]]:
    """Read the settings of each light by its name, as the text that an option would have.

    [0.5, 0.3, 1] is "0.5,0.3,1". Raises InputError for a file that holds no lights.
    """
    kind = dict[str, dict[str, Annotated[str, BeforeValidator(_text_of_option)]]]
    lights = checked(kind, read_toml(path, "see docs/lights.md"), str(path))
    if not 1 <= len(lights) <= MOST_RIG_LIGHTS:
        raise InputError(f"{path}: {len(lights)} lights; give 1 to {MOST_RIG_LIGHTS}")
    return lights


def _text_of_option(value: Any) -> str:
    if isinstance(value, str):
        return value
    parts = value if isinstance(value, list) else [value]
    try:
        if all(type(part) in (int, float) for part in parts):
            return ",".join(f"{float(part)!r}" for part in parts)
    except OverflowError:
        pass
    raise ValueError("give numbers, lists of them, or text such as '0:360:24'")


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


def _name(text: str) -> str:
    if not is_name(text):
        raise ValueError("a name of letters, digits, - and _ is needed")
    return text


def _array(shape: tuple[int, ...], value: Any) -> np.ndarray:
    try:
        array = np.array(value)
    except ValueError:  # rows of different lengths
        array = np.zeros(())
    if array.shape != shape or array.dtype.kind not in "if" or not (np.abs(array) < _LARGEST).all():
        raise ValueError(f"{' x '.join(map(str, shape))} finite numbers are needed")
    return array.astype(np.float64)


def _unit(direction: np.ndarray) -> np.ndarray:
    length = np.linalg.norm(direction)
    if not abs(length - 1) < _UNIT_TOLERANCE:
        raise ValueError("a vector of length 1 is needed")
    return direction / length


Name = Annotated[str, AfterValidator(_name)]  # can be part of a file's name
Three = Annotated[np.ndarray, PlainValidator(partial(_array, (3,)))]
Direction = Annotated[Three, AfterValidator(_unit)]  # normalized
Matrix3 = Annotated[np.ndarray, PlainValidator(partial(_array, (3, 3)))]
Points68 = Annotated[np.ndarray, PlainValidator(partial(_array, (68, 2)))]


def distinct(names: list[str], what: str) -> list[str]:
    """Return names among which none occurs twice; raises ValueError, which names the first that does."""
    seen: set[str] = set()
    for name in names:
        if name in seen:
            raise ValueError(f"{what} {name!r} occurs twice")
        seen.add(name)
    return names
