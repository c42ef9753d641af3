"""Synthetic people and skies, their stage, and the banks that networks are trained on."""

import tomllib
from pathlib import Path
from typing import Any


def tables_of(module_file: str) -> dict[str, Any]:
    """Read the TOML file next to a module, given the module's `__file__`."""
    return tomllib.loads(Path(module_file).with_suffix(".toml").read_text(encoding="utf-8"))
