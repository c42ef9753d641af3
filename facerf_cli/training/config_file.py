"""The configuration file of a training, which each run writes as DIR/config.toml. Light to import.

[train] has options of the command line; [train.loss], [train.optimizer] and [train.schedule] have the rest.
"""

import json
import math
from collections.abc import Mapping
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

from facerf_cli.errors import UsageError
from facerf_cli.files.atomic import atomic_path
from facerf_cli.training.settings import KINDS, TrainSettings

CONFIG = "config.toml"
_BELOW_1 = ("rho", "betas", "floor")


def with_tables(training: TrainSettings, tables: Mapping[str, Any]) -> TrainSettings:
    """Change settings by the tables `loss`, `optimizer` and `schedule`; UsageError for a wrong one."""
    changed = {name: _changed(getattr(training, name), name, table) for name, table in tables.items()}
    return replace(training, **changed)


def _changed(before: Any, name: str, table: Any) -> Any:
    """A group of settings with a table's values; `name` in the table chooses another kind of it."""
    where, kinds = f"--config: [train.{name}]", KINDS[name]
    if not isinstance(table, Mapping):
        raise UsageError(f"{where} is no table; write [train.{name}]")
    chosen = table.get("name", type(before).__name__)
    if chosen not in kinds:
        raise UsageError(f"{where} name is {chosen!r}; give one of {', '.join(kinds)}")
    values = asdict(before if kinds[chosen] is type(before) else kinds[chosen]())
    for key in table.keys() - {"name"}:
        if key not in values:
            raise UsageError(f"{where} {key}: no such setting; give one of {', '.join(values)}")
        values[key] = _like(values[key], table[key], f"{where} {key}")
    return kinds[chosen](**values)


def _like(default: Any, value: Any, where: str) -> Any:
    """A value as true or false, or numbers of the default's kind and count, from 0 on."""
    if isinstance(default, bool):
        if not isinstance(value, bool):
            raise UsageError(f"{where} is {value}; give true or false")
        return value
    several = isinstance(default, tuple)
    numbers = list(value) if several and isinstance(value, list) else [value]
    kind = int if isinstance(default, int) else (int, float)
    most = 1.0 if where.endswith(_BELOW_1) else math.inf
    sound = [isinstance(x, kind) and not isinstance(x, bool) and 0 <= x < most for x in numbers]
    if not all(sound) or len(numbers) != (len(default) if several else 1):
        wanted = f"{len(default)} numbers" if several else "a whole number" if kind is int else "a number"
        raise UsageError(f"{where} is {value}; give {wanted} from 0{' to below 1' if most == 1 else ' on'}")
    return tuple(map(float, numbers)) if several else type(default)(value)


def write_config(folder: Path, options: Mapping[str, Any], training: TrainSettings, seed: int) -> None:
    """Write DIR/config.toml: the options of the command line by name, and all other settings in force."""
    tables = {"global": {"seed": seed}, "train": options}
    for name in KINDS:
        group = getattr(training, name)
        kind = {"name": type(group).__name__} if len(KINDS[name]) > 1 else {}
        tables[f"train.{name}"] = kind | asdict(group)
    text = "\n".join(
        "".join([f"[{name}]\n", *(f"{key} = {_toml(value)}\n" for key, value in table.items())])
        for name, table in tables.items()
    )
    with atomic_path(folder / CONFIG) as temporary:
        temporary.write_text(text, encoding="utf-8")


def _toml(value: Any) -> str:
    """A value in TOML, whose strings, numbers and lists are JSON's; paths are made absolute."""
    return json.dumps(str(value.absolute()) if isinstance(value, Path) else value)
