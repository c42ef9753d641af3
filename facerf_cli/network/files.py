"""Which checkpoint serves each network: a user's files, and behind them the ones that ship.

Only the headers of checkpoints are read, so that nothing heavy is imported.
"""

from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from facerf_cli.errors import InputError, UsageError
from facerf_cli.files.texts import parse_json

FORMAT = "facerf-checkpoint-1"
BEST = "best.safetensors"  # in a run's folder
_ASSETS = Path(__file__).parents[1] / "assets"
# The shipped file of each network that verbs use.
SHIPPED = {
    "reflectance": _ASSETS / "default.safetensors",
    "geometry": _ASSETS / "default.safetensors",
    "diffuse_sh": _ASSETS / "diffuse_sh.safetensors",
    "light_features": _ASSETS / "light_features.safetensors",
    "parsing": _ASSETS / "parsing.safetensors",
    "portrait": _ASSETS / "portrait.safetensors",
}
_TITLES = {
    "reflectance": "Reflectance Network",
    "geometry": "Geometry Network",
    "diffuse_sh": "network of diffuse-sh",
    "light_features": "network S_f",
    "parsing": "Parsing Network",
    "portrait": "Portrait Network",
}


@dataclass(frozen=True)
class _Held:
    """Names of the networks of a checkpoint: all, and those that its last training trained."""

    path: Path
    networks: tuple[str, ...]
    trained: tuple[str, ...]


def checkpoint_file(path: Path) -> Path:
    """The checkpoint that `--checkpoint` names: a file, or the best one of a run's folder."""
    return path / BEST if path.is_dir() else path


def read_metadata(path: Path) -> dict[str, Any]:
    """Read the metadata of a checkpoint; raises InputError for any other file."""
    from safetensors import SafetensorError, safe_open

    if not path.is_file():
        where = (
            f"{path.parent}: no {BEST} in this folder" if path.name == BEST else f"{path}: no such checkpoint"
        )
        raise InputError(f"{where}; give a .safetensors file that `facerf train` wrote, or a run's folder")
    try:
        with safe_open(path, framework="np") as file:
            header = file.metadata() or {}
        metadata = parse_json(header["facerf"])
        if not isinstance(metadata, dict):
            raise ValueError("its metadata is not a JSON object")
    except (SafetensorError, OSError, KeyError, ValueError, RecursionError, RuntimeError) as error:
        reason = "the file is empty" if not path.stat().st_size else error
        raise InputError(
            f"{path}: not a facerf checkpoint ({reason}); give a file that `facerf train` wrote"
        ) from None
    if header.get("format") != FORMAT:
        raise InputError(f"{path}: written by another version of facerf; train or fetch the checkpoint again")
    return metadata


def serving_files(given: Sequence[Path], uses: Collection[str] = SHIPPED, user: str = "") -> dict[str, Path]:
    """Return the file that serves each network.

    A file counts for the networks that its last training trained. The copies that it carries count where no
    other file gives them; what no file gives comes from the shipped ones.

    Args:
        given: the user's checkpoints.
        uses: names of the networks that are needed.
        user: who needs them, for the error of a file that serves none of them.

    Raises InputError where two files trained the same network, or a file serves no network.
    """
    held = [_held_by(path) for path in given]
    found = dict(SHIPPED)
    for one in reversed(held):
        found.update(dict.fromkeys(one.networks, one.path))
    trained: dict[str, Path] = {}
    for one in held:
        for name in one.trained:
            if name in trained:
                raise UsageError(
                    f"--checkpoint {one.path}: holds a {title_of(name)}, as does {trained[name]}; "
                    "give one of them"
                )
            trained[name] = one.path
    found |= trained
    serving = {name: found[name] for name in SHIPPED if name in uses}
    for one in held:
        if one.path not in serving.values():
            has = " and ".join(map(title_of, one.trained or one.networks)) or "no network"
            needs = f"{user} uses the {_listed(serving)}" if serving else f"{user} uses no network"
            raise UsageError(f"--checkpoint {one.path}: holds a {has}, but {needs}; leave it out")
    return serving


def _held_by(path: Path) -> _Held:
    metadata = read_metadata(path)
    try:
        networks = tuple(map(str, metadata["networks"]))
        last = metadata["training"][-1] if metadata.get("training") else {}
        trained = tuple(name for name in last.get("networks", networks) if name in networks)
    except (LookupError, TypeError, AttributeError):
        raise InputError(f"{path}: does not say what networks it holds; train it again") from None
    return _Held(path, networks, trained or networks)


def title_of(name: str) -> str:
    """Name of a network in messages."""
    return _TITLES.get(name, f"network {name}")


def _listed(names: Iterable[str]) -> str:
    *before, last = map(title_of, names)
    return f"{', '.join(before)} and {last}" if before else last
