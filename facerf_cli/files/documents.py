"""JSON documents and TOML rigs: pydantic validates them; JSON is written strictly.

An error is one line with the file and the path to the entry, such as `stage.json: lights[2]: id: ...`. Import
this module only where a document is read: pydantic takes a tenth of a second.
"""

import hashlib
import json
import re
from collections import Counter
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

from facerf_cli.errors import InputError
from facerf_cli.files.atomic import atomic_path
from facerf_cli.files.texts import read_json, read_toml
from facerf_cli.run.logs import one_line

# Names become parts of paths: no separators, no hidden files, no way out of a folder.
_NAME = re.compile(r"[A-Za-z0-9_+@=-][A-Za-z0-9_+@=. -]{0,99}")
_RESERVED_ENDS = (" ", ".", ".json", ".jsonl")  # a dataset's own files have the last two
MOST_RIG_LIGHTS = 32
_LARGEST = 1e12  # magnitude of a number; keeps products of two finite
_UNIT_TOLERANCE = 1e-3  # of a direction's length
_OBJECT = "use an object { }"
_ADVICE = {"missing": "is missing; add it", "list_type": "use a list [ ]"}
_ADVICE |= {"model_type": _OBJECT, "dict_type": _OBJECT}

Kind = TypeVar("Kind")


class Document(BaseModel):
    """Object of a document; unknown keys are ignored, and no value is converted to another type."""

    model_config = ConfigDict(strict=True, frozen=True, allow_inf_nan=False, protected_namespaces=())


def read_document(path: Path, kind: type[Kind], missing: str) -> Kind:
    """Read a JSON document as a model or another type; `missing` is the advice if the file is missing."""
    return checked(kind, read_json(path, missing), str(path))


def checked(kind: type[Kind], value: Any, where: str) -> Kind:
    """Return a parsed value as a type; an InputError names `where` it is and its first invalid entry."""
    try:
        return cast(Kind, _adapter(cast(Any, kind)).validate_python(value))
    except ValidationError as error:
        first, *others = error.errors(include_url=False)
        for part in first["loc"]:
            where += f"[{part}]" if isinstance(part, int) else f": {part}"
        message = _ADVICE.get(first["type"], first["msg"].removeprefix("Value error, "))
        message = "is null; fill it in" if first["input"] is None else message
        more = f" (and {len(others)} more)" if others else ""
        raise InputError(one_line(f"{where}: {message}{more}")) from None


@cache  # pydantic compiles it
def _adapter(kind: Any) -> TypeAdapter[Any]:
    return TypeAdapter(kind)


def read_rig(path: Path) -> dict[str, dict[str, str]]:
    """Read the settings of each light by its name, as the text of the option, such as "0.5,0.3,1".

    Raises InputError for a file without lights.
    """
    kind = dict[str, dict[str, Annotated[str, BeforeValidator(_text_of_option)]]]
    lights = checked(kind, read_toml(path, "see docs/lights.md"), str(path))
    if not 1 <= len(lights) <= MOST_RIG_LIGHTS:
        raise InputError(f"{path}: {len(lights)} lights; use 1 to {MOST_RIG_LIGHTS}")
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
    raise ValueError("use numbers, lists of numbers, or text such as '0:360:24'")


def write_document(path: Path, content: Mapping[str, Any]) -> None:
    """Write an indented JSON file atomically; raises ValueError for NaN and infinity."""
    with atomic_path(path) as temporary:
        temporary.write_text(json_text(content, indent=1) + "\n", encoding="utf-8")


def json_text(value: Any, indent: int | None = None) -> str:
    """Return strict JSON in one line, or indented; raises ValueError for NaN and infinity.

    Unpaired surrogates, which UTF-8 cannot encode, are written as escapes. `logs.json_line` is the lenient
    form for rows of logs and reports: it accepts paths and arrays, and writes NaN as null.
    """
    text = json.dumps(value, allow_nan=False, ensure_ascii=False, indent=indent)
    return text.encode(errors="backslashreplace").decode()


def digest(content: bytes) -> str:
    """Return 16 hex digits of the SHA-256, which identify contents in file names and records."""
    return hashlib.sha256(content).hexdigest()[:16]


def is_name(text: str) -> bool:
    """Return whether a text can be part of a file name, as the id of a subject, a camera or a light."""
    return bool(_NAME.fullmatch(text)) and not text.endswith(_RESERVED_ENDS)


def _name(text: str) -> str:
    if not is_name(text):
        raise ValueError("use a name of letters, digits, - and _")
    return text


def _array(shape: tuple[int, ...], value: Any) -> np.ndarray:
    try:
        array = np.array(value)
    except ValueError:  # rows of different lengths
        array = np.zeros(())
    if array.shape != shape or array.dtype.kind not in "if" or not (np.abs(array) < _LARGEST).all():
        raise ValueError(f"use {' x '.join(map(str, shape))} finite numbers")
    return array.astype(np.float64)


def _unit(direction: np.ndarray) -> np.ndarray:
    length = np.linalg.norm(direction)
    if not abs(length - 1) < _UNIT_TOLERANCE:
        raise ValueError("use a vector of length 1")
    return direction / length


Name = Annotated[str, AfterValidator(_name)]  # can be part of a file name
Three = Annotated[np.ndarray, PlainValidator(partial(_array, (3,)))]
Direction = Annotated[Three, AfterValidator(_unit)]  # normalized
Matrix3 = Annotated[np.ndarray, PlainValidator(partial(_array, (3, 3)))]
Points68 = Annotated[np.ndarray, PlainValidator(partial(_array, (68, 2)))]


def distinct(names: list[str], what: str) -> list[str]:
    """Return names that are distinct; raises ValueError with the first that occurs twice."""
    if twice := [name for name, count in Counter(names).items() if count > 1]:
        raise ValueError(f"{what} {twice[0]!r} occurs twice")
    return names
