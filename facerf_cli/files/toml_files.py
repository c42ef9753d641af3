"""TOML files that users write: bounded, and read without running anything; rigs of studio lights in them."""

import tomllib
from pathlib import Path
from typing import Any

from facerf_cli.errors import InputError
from facerf_cli.files.regular import require_regular

MOST_RIG_LIGHTS = 32
_RIG_LIMIT_BYTES = 1 << 16

Settings = dict[str, str]


def read_toml(path: Path, limit_bytes: int, too_long: str, advice: str) -> dict[str, Any]:
    """Read the tables of a TOML file.

    Raises InputError, which says `too_long` of a file over the limit, and `advice` of one that is no TOML.
    """
    require_regular(path)
    try:
        with path.open("rb") as stream:
            data = stream.read(limit_bytes + 1)
        if len(data) > limit_bytes:
            raise InputError(f"{path}: {too_long}")
        return tomllib.loads(data.decode())
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}); check the path") from None
    except (ValueError, RecursionError) as error:  # also of the decoding
        raise InputError(f"{path}: not TOML ({error}); {advice}") from None


def read_rig(path: Path) -> dict[str, Settings]:
    """Read the settings of each light by its name, as the text that an option would have.

    [0.5, 0.3, 1] is "0.5,0.3,1". Raises InputError for a file that holds no lights.
    """
    too_long = f"more than {_RIG_LIMIT_BYTES} bytes; a rig file holds lights alone"
    tables = read_toml(path, _RIG_LIMIT_BYTES, too_long, "see docs/lights.md")
    if not 1 <= len(tables) <= MOST_RIG_LIGHTS:
        raise InputError(f"{path}: {len(tables)} lights; give 1 to {MOST_RIG_LIGHTS}")
    return {name: _settings(table, f"{path}: {name}") for name, table in tables.items()}


def _settings(table: Any, where: str) -> Settings:
    if not isinstance(table, dict):
        raise InputError(f"{where}: not a light; write [NAME], and its keys below")
    return {key: _text(value, f"{where}: {key}") for key, value in table.items()}


def _text(value: Any, where: str) -> str:
    parts = value if isinstance(value, list) else [value]
    if isinstance(value, str):
        return value
    try:
        if all(type(part) in (int, float) for part in parts):
            return ",".join(f"{float(part)!r}" for part in parts)
    except OverflowError:
        pass
    raise InputError(f"{where}: not a number; give numbers, lists of them, or text such as '0:360:24'")
