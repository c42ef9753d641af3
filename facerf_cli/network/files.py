"""Choice of a checkpoint for each network: the user's files, else the shipped ones.

Only headers of checkpoints are read, so that nothing heavy is imported.
"""

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from facerf_cli.errors import InputError, UsageError
from facerf_cli.files.texts import parse_json

FORMAT = "facerf-checkpoint-1"
BEST = "best.safetensors"  # in a run's folder
_ASSETS = Path(__file__).parents[1] / "assets"
# Shipped file of each network.
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
class _Networks:
    """Names of a checkpoint's networks: all, and the ones trained last."""

    path: Path
    networks: tuple[str, ...]
    trained: tuple[str, ...]


def checkpoint_file(path: Path) -> Path:
    """Return the file for a value of `--checkpoint`: a file, or the best checkpoint of a run's folder."""
    return path / BEST if path.is_dir() else path


def read_metadata(path: Path) -> dict[str, Any]:
    """Read the metadata of a checkpoint; raises InputError for any other file."""
    from safetensors import SafetensorError, safe_open

    if not path.is_file():
        where = (
            f"{path.parent}: no {BEST} in this folder" if path.name == BEST else f"{path}: no such checkpoint"
        )
        raise InputError(f"{where}; use a .safetensors file that `facerf train` wrote, or a run's folder")
    try:
        with safe_open(path, framework="np") as file:
            header = file.metadata() or {}
        metadata = parse_json(header["facerf"])
        if not isinstance(metadata, dict):
            raise ValueError("its metadata is not a JSON object")
    except (SafetensorError, OSError, KeyError, ValueError, RecursionError, RuntimeError) as error:
        reason = "the file is empty" if not path.stat().st_size else error
        raise InputError(
            f"{path}: not a facerf checkpoint ({reason}); use a file that `facerf train` wrote"
        ) from None
    if header.get("format") != FORMAT:
        raise InputError(f"{path}: written by another version of facerf; train or fetch the checkpoint again")
    return metadata


def serving_files(given: Sequence[Path], uses: Collection[str] = SHIPPED, user: str = "") -> dict[str, Path]:
    """Return the file of each network.

    A file provides the networks that its last training trained. Its other networks are used if no other file
    provides them. All others are the shipped ones.

    Args:
        given: The user's checkpoints.
        uses: Names of the required networks.
        user: Name of the command, for the error about an unused file.

    Raises UsageError if two files trained the same network, or a file is not used.
    """
    checkpoints = [_read_names(path) for path in given]
    files = dict(SHIPPED)
    for checkpoint in reversed(checkpoints):
        files.update(dict.fromkeys(checkpoint.networks, checkpoint.path))
    trained: dict[str, Path] = {}
    for checkpoint in checkpoints:
        for name in checkpoint.trained:
            if name in trained:
                both = f"contains a {title_of(name)}, but so does {trained[name]}"
                raise UsageError(f"--checkpoint {checkpoint.path}: {both}; use one of them")
            trained[name] = checkpoint.path
    files |= trained
    serving = {name: files[name] for name in SHIPPED if name in uses}
    for checkpoint in checkpoints:
        if checkpoint.path not in serving.values():
            has = " and ".join(map(title_of, checkpoint.trained)) or "no network"
            *before, last = map(title_of, serving) if serving else ["no network"]
            needs = f"{', '.join(before)} and {last}" if before else last
            raise UsageError(
                f"--checkpoint {checkpoint.path}: contains {has}; {user} uses {needs}; remove it"
            )
    return serving


def _read_names(path: Path) -> _Networks:
    metadata = read_metadata(path)
    try:
        networks = tuple(map(str, metadata["networks"]))
        last = metadata["training"][-1] if metadata.get("training") else {}
        trained = tuple(name for name in last.get("networks", networks) if name in networks)
    except (LookupError, TypeError, AttributeError):
        raise InputError(f"{path}: does not name its networks; train it again") from None
    return _Networks(path, networks, trained or networks)


def title_of(name: str) -> str:
    """Return the name of a network in messages."""
    return _TITLES.get(name, f"network {name}")
