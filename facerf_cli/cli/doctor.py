"""`facerf doctor`: what is installed and what it may be used for, on one screen."""

import importlib.metadata
import os
import platform
import re
import textwrap
from pathlib import Path
from typing import Annotated, Any

import typer

from facerf_cli import __version__
from facerf_cli.cli.options import Settings, settings_of, torch_device
from facerf_cli.errors import FacerfError
from facerf_cli.logs import json_line

_WIDTH = 100
MISSING = "MISSING"


def doctor(
    context: typer.Context,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object instead.")] = False,
) -> None:
    """Say what is installed, which device, assets and licences, and which colour configuration.

    The exit code is 1 where something that facerf needs is missing.
    """
    facts = examine(settings_of(context))
    print(json_line(facts) if as_json else as_screen(facts))
    raise typer.Exit(1 if MISSING in json_line(facts) else 0)


def examine(settings: Settings) -> dict[str, dict[str, Any]]:
    """Everything that the doctor looks at, by section."""
    from facerf_cli.face.morphable import BUILTIN_PATH
    from facerf_cli.models import DEFAULT_CHECKPOINT

    return {
        "facerf": {
            "version": __version__,
            "python": platform.python_version(),
            "system": platform.platform(),
        },
        "packages": _packages(),
        "device": _device(settings),
        "assets": {
            "face model": _face_model(BUILTIN_PATH),
            "checkpoint": _checkpoint(settings.checkpoint or DEFAULT_CHECKPOINT),
            "landmarks": _landmark_model(),
        },
        "colour": _colour_configuration(),
        "cache": {"folder": _cache_folder()},
    }


def as_screen(facts: dict[str, dict[str, Any]]) -> str:
    """The facts as aligned text."""
    lines = []
    for section, entries in facts.items():
        if section == "packages":
            text = "  ".join(f"{name} {version}" for name, version in entries.items())
            lines += textwrap.wrap(text, _WIDTH, initial_indent=f"{section:<12}", subsequent_indent=" " * 12)
            continue
        for row, (name, value) in enumerate(entries.items()):
            values = value.values() if isinstance(value, dict) else [value]
            text = ", ".join(str(part) for part in values if part not in ("", None))
            head = f"{section if row == 0 else '':<12}{name:<12}"
            lines += textwrap.wrap(text, _WIDTH, initial_indent=head, subsequent_indent=" " * 24)
    return "\n".join(lines)


def _packages() -> dict[str, str]:
    """Versions of what facerf requires, and of the extras that are here."""
    try:
        requirements = importlib.metadata.requires("facerf") or []
    except importlib.metadata.PackageNotFoundError:
        return {"facerf": f"{MISSING} (run from its source; install it with pip)"}
    versions = {}
    for requirement in requirements:
        name = re.split(r"[^\w.-]", requirement, maxsplit=1)[0]
        try:
            versions[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            if "extra ==" not in requirement:
                versions[name] = MISSING
    return versions


def _device(settings: Settings) -> dict[str, Any]:
    import torch

    device = torch_device(settings)
    name = torch.cuda.get_device_name(device) if device.type == "cuda" else platform.processor() or "cpu"
    memory = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 2**30
    return {
        "torch uses": f"{device} ({name})",
        "threads": torch.get_num_threads(),
        "memory": f"{memory:.0f} GiB",
        "seed": settings.seed,
    }


def _face_model(path: Path) -> dict[str, str]:
    import numpy as np

    if not path.is_file():
        return {"name": MISSING, "file": str(path)}
    try:
        with np.load(path, allow_pickle=False) as arrays:
            return {"name": str(arrays["name"]), "licence": str(arrays["licence"]), "size": _size(path)}
    except (ValueError, OSError, KeyError) as error:
        return {"name": f"{MISSING}: damaged, {error}", "file": str(path)}


def _checkpoint(path: Path) -> dict[str, Any]:
    from facerf_cli.network.checkpoint import load_checkpoint

    try:
        _, metadata = load_checkpoint(path)
    except FacerfError as error:
        return {"name": f"{MISSING}: {error}"}
    made_from = metadata.get("provenance", {})
    return {"name": path.stem, "licence": metadata.get("licence"), "size": _size(path), **made_from}


def _landmark_model() -> dict[str, str]:
    from facerf_cli.face.landmarks import DETECTOR_LICENCE, PREDICTOR_LICENCE, predictor_path
    from facerf_cli.face.recognition import RECOGNITION_LICENCE

    try:
        size = _size(predictor_path())
    except FacerfError as error:
        size = f"{MISSING}: {error}"
    return {
        "points": PREDICTOR_LICENCE,
        "size": size,
        "detector": DETECTOR_LICENCE,
        "recognition": RECOGNITION_LICENCE,
    }


def _colour_configuration() -> dict[str, Any]:
    import OpenImageIO as oiio

    configuration = oiio.ColorConfig()
    trouble = configuration.geterror()
    if trouble:
        raise FacerfError(f"$OCIO is {os.environ.get('OCIO', '')!r}: {trouble}")
    return {"OCIO": configuration.configname(), "spaces": configuration.getNumColorSpaces()}


def _cache_folder() -> str:
    import platformdirs

    return platformdirs.user_cache_dir("facerf")


def _size(path: Path) -> str:
    return f"{path.stat().st_size / 2**20:.1f} MiB"
