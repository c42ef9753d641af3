"""What an evaluation depends on, told apart by a key: one table never mixes two ways of measuring."""

import dataclasses
import hashlib
from collections.abc import Callable, Mapping
from functools import cache
from pathlib import Path
from typing import Any

from facerf_cli import __version__
from facerf_cli.commands.evaluation_options import EvaluateOptions
from facerf_cli.commands.options import Settings
from facerf_cli.errors import InputError
from facerf_cli.records import json_line

# Settings that change no figure, wherever they stand; and those that are a name or a file's path.
_WITHOUT_EFFECT = {"output", "jobs", "overwrite", "dry_run", "verbosity", "log_json", "device", "checkpoint"}
_WITHOUT_EFFECT |= {"shard", "ray", "output_base"}
_NAME_OR_PATH = {"face_model", "vgg_weights"}


def evaluation_key(
    protocol: str, compare: Callable[..., Any], options: EvaluateOptions, settings: Settings
) -> str:
    """16 digits that differ where figures may: by version, protocol, its settings, options and networks."""
    facts = {
        "version": __version__,
        "protocol": protocol,
        "compare": _plain(compare),
        "options": _plain(options),
        "networks": networks_of(options, settings),
        "others": [_files_of(folder) for folder in options.compare],
    }
    return hashlib.sha256(json_line(facts).encode("utf-8", "backslashreplace")).hexdigest()[:16]


def item_key(key: str, path: Path) -> str:
    """The key of one item: another file of the same name is another picture."""
    return hashlib.sha256(json_line({"run": key, "item": _plain(path)}).encode()).hexdigest()[:16]


def networks_of(options: EvaluateOptions, settings: Settings) -> dict[str, str]:
    """SHA-256 of the checkpoints by what they are for; none where no reflectance model is asked for."""
    if not options.reflectance:
        return {}
    from facerf_cli.pipeline import DEFAULT_CHECKPOINT

    own = settings.checkpoint or DEFAULT_CHECKPOINT
    against = {f"against {path.stem}": _sha256(path) for path in options.against}
    return {own.stem: _sha256(own), **against}


def _files_of(folder: Path) -> list[Any]:
    """What tells a folder of predictions from the same folder rewritten."""
    return [_plain(path) for path in sorted(folder.rglob("*")) if path.is_file()]


@cache
def _sha256(path: Path) -> str:
    try:
        with path.open("rb") as stream:
            return hashlib.file_digest(stream, "sha256").hexdigest()
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror or error})") from None


def _plain(value: Any) -> Any:
    """Settings as JSON can have them; what is no setting is told by its type alone.

    A path is told by what it leads to, however it was written; a file by its size and time as well.
    """
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        fields = {field.name for field in dataclasses.fields(value)} - _WITHOUT_EFFECT
        return {"type": type(value).__name__} | {name: _field(value, name) for name in sorted(fields)}
    if isinstance(value, Mapping):
        return [[_plain(name), _plain(entry)] for name, entry in value.items()]
    if isinstance(value, (list, tuple)):
        return [_plain(entry) for entry in value]
    if isinstance(value, (set, frozenset)):
        return sorted(map(str, value))
    if isinstance(value, Path):
        facts = value.stat() if value.is_file() else None
        return [value.resolve(), *((facts.st_size, facts.st_mtime_ns) if facts else ())]
    if isinstance(value, (str, int, float, bool)) or value is None:
        return value
    return value.tolist() if hasattr(value, "tolist") else type(value).__name__


def _field(settings: Any, name: str) -> Any:
    value = getattr(settings, name)
    is_file = name in _NAME_OR_PATH and value is not None and Path(value).is_file()
    return _plain(Path(value) if is_file else value)
