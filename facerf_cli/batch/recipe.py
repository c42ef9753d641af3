"""Recipes of outputs: the options, files and networks that shape them, as JSON, and their digest."""

import dataclasses
import hashlib
import json
import os.path
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

from facerf_cli.errors import UsageError

RESULTS_VERSION = 29  # increased when the same recipe gives different pixels
SHIPPED = Path(__file__).parents[1] / "assets"

Recipe = dict[str, Any]  # names and JSON values
DigestOf = Callable[[Path], str]  # SHA-256 of a file
RecipesOf = Callable[[DigestOf], Sequence[Recipe]]  # of each output of an item, or one for all of them


def recipe_of(settings: Any, digest_of: DigestOf) -> Recipe:
    """List the fields of a dataclass, and of dataclasses in it, that shape outputs.

    Files count by their content. The user's checkpoints are followed by the networks that facerf ships.
    """
    recipe: Recipe = {"results": RESULTS_VERSION}
    _add_fields(recipe, settings, digest_of)
    return recipe


def key_of(recipe: Recipe) -> str:
    """Return a short digest of a recipe, for the keys of outputs and the names of cached files."""
    text = json.dumps(recipe, sort_keys=True)
    return hashlib.sha256(text.encode("utf-8", "backslashreplace")).hexdigest()[:16]


def _add_fields(recipe: Recipe, settings: Any, digest_of: DigestOf) -> None:
    for field in dataclasses.fields(settings):
        value = getattr(settings, field.name)
        if not field.metadata.get("in_recipe", True):
            continue
        if dataclasses.is_dataclass(value):
            _add_fields(recipe, value, digest_of)
        elif field.name == "checkpoints":
            recipe["checkpoint"] = _content([*value, *sorted(SHIPPED.glob("*.safetensors"))], digest_of)
        else:
            recipe[field.name] = _plain(value, digest_of)


def _plain(value: Any, digest_of: DigestOf) -> Any:
    """Convert a value to JSON; files, named by a path or by text, become digests of their content."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        inner: Recipe = {}
        _add_fields(inner, value, digest_of)
        return inner
    if isinstance(value, (tuple, list)):
        return [_plain(entry, digest_of) for entry in value]
    if isinstance(value, (str, Path)) and os.path.isfile(value):
        return _content([Path(value)], digest_of)
    if isinstance(value, Path):
        return _of_folder(value, digest_of)
    return value


def _of_folder(path: Path, digest_of: DigestOf) -> str:
    """Return the digests of a folder's files; for a pattern (mattes/{stem}.png), of its fixed folder."""
    fixed, brace, rest = str(path).partition("{")
    folder = Path(f"{fixed}_").parent if brace else path
    files = (file for file in folder.rglob("*") if file.is_file()) if folder.is_dir() else ()
    return f"{brace}{rest}{_content(sorted(files), digest_of)}"


def _content(files: Iterable[Path], digest_of: DigestOf) -> str:
    return "sha256:" + " ".join(digest_of(path)[:16] for path in files)


def require_same(before: Recipe, now: Recipe, what: str, advice: str) -> None:
    """Raise UsageError, `WHAT: other crop, seed; ADVICE`, if two recipes differ."""
    names = sorted(name for name in before.keys() | now.keys() if before.get(name) != now.get(name))
    if names:
        raise UsageError(f"{what}: other {', '.join(names).replace('_', ' ')}; {advice}")
