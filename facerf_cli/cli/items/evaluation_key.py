"""Keys of all that figures depend on, so that one table never mixes two ways of measuring."""

import dataclasses
from collections.abc import Callable, Mapping
from functools import cache
from pathlib import Path
from typing import Any

from facerf_cli import __version__
from facerf_cli.cli.evaluation_options import EvaluateOptions
from facerf_cli.cli.options import Settings
from facerf_cli.errors import InputError
from facerf_cli.files.documents import digest
from facerf_cli.files.downloads import file_sha256
from facerf_cli.logs import json_line
from facerf_cli.models import DEFAULT_CHECKPOINT

# Fields that change no figure; and fields that hold a name or a file's path.
_WITHOUT_EFFECT = {"output", "jobs", "overwrite", "dry_run", "verbosity", "log_json", "device", "checkpoint"}
_WITHOUT_EFFECT |= {"shard", "ray", "output_base"}
_MEASURING = 4  # raised when the same options give other figures
_NAME_OR_PATH = {"face_model", "vgg_weights"}


def evaluation_key(
    protocol: str, compare: Callable[..., Any], options: EvaluateOptions, settings: Settings
) -> str:
    """16 digits that depend on all that figures depend on: version, protocol, settings, options, networks."""
    facts = {
        "version": __version__,
        "measuring": _MEASURING,
        "protocol": protocol,
        "compare": _plain(compare),
        "options": _plain(options),
        "networks": networks_of(options, settings),
        "others": [_files_of(folder) for folder in options.compare],
    }
    return digest(json_line(facts).encode("utf-8", "backslashreplace"))


def item_key(key: str, path: Path) -> str:
    """The key of one item, which differs for another file of the same name."""
    return digest(json_line({"run": key, "item": _plain(path)}).encode())


def networks_of(options: EvaluateOptions, settings: Settings) -> dict[str, str]:
    """SHA-256 of each checkpoint by its name; empty where no reflectance model is measured."""
    if not options.reflectance:
        return {}
    own = settings.checkpoint or DEFAULT_CHECKPOINT
    against = {f"against {path.stem}": _sha256(path) for path in options.against}
    return {own.stem: _sha256(own), **against}


def _files_of(folder: Path) -> list[Any]:
    """Paths, sizes and times of a folder of predictions, which change when it is rewritten."""
    return [_plain(path) for path in sorted(folder.rglob("*")) if path.is_file()]


@cache
def _sha256(path: Path) -> str:
    try:
        return file_sha256(path)
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror or error}); check the path") from None


def _plain(value: Any) -> Any:
    """Settings as JSON values; for other objects the name of their type.

    A path is resolved, however it was written; a file has its size and time as well.
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
