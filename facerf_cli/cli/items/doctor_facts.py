"""The device, assets, colour configuration and cache that `facerf doctor` shows."""

import os
from pathlib import Path
from typing import Any

import numpy as np
import OpenImageIO as oiio
import platformdirs
import torch

from facerf_cli import portrait_field
from facerf_cli.cli.doctor import MISSING
from facerf_cli.cli.options import Settings, torch_device
from facerf_cli.errors import FacerfError
from facerf_cli.face.detector import DETECTOR_LICENCE
from facerf_cli.face.dlib_landmarks import PREDICTOR_LICENCE, predictor_path
from facerf_cli.face.morphable import BUILTIN_PATH
from facerf_cli.face.recognition import RECOGNITION_LICENCE
from facerf_cli.models import DEFAULT_CHECKPOINT
from facerf_cli.network.checkpoint import load_checkpoint
from facerf_cli.portrait import parse


def examine(settings: Settings) -> dict[str, dict[str, Any]]:
    """The facts of this machine by section."""
    return {
        "device": _device(settings),
        "assets": {
            "face model": _face_model(BUILTIN_PATH),
            "checkpoint": _checkpoint(settings.checkpoint or DEFAULT_CHECKPOINT),
            "parsing": _of_people(parse.SHIPPED),
            "portrait": _of_people(portrait_field.SHIPPED),
            "detector": {"licence": DETECTOR_LICENCE},
            "dlib": _extra_models(),
        },
        "colour": _colour_configuration(),
        "cache": {"folder": platformdirs.user_cache_dir("facerf")},
    }


def _device(settings: Settings) -> dict[str, Any]:
    device = torch_device(settings)
    built = f"built for CUDA {torch.version.cuda}" if torch.version.cuda else "built without CUDA"
    name = torch.cuda.get_device_name(device) if device.type == "cuda" else f"this torch is {built}"
    memory = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 2**30
    return {
        "uses": f"{device} ({name})",
        "threads": torch.get_num_threads(),
        "memory": f"{memory:.0f} GiB",
        "seed": settings.seed,
    }


def _face_model(path: Path) -> dict[str, str]:
    if not path.is_file():
        return {"name": MISSING, "file": str(path)}
    try:
        with np.load(path, allow_pickle=False) as arrays:
            return {"name": str(arrays["name"]), "licence": str(arrays["licence"]), "size": _size(path)}
    except (ValueError, OSError, KeyError) as error:
        return {"name": f"{MISSING}: damaged, {error}", "file": str(path)}


def _checkpoint(path: Path) -> dict[str, Any]:
    try:
        _, metadata = load_checkpoint(path)
    except FacerfError as error:
        return {"name": f"{MISSING}: {error}"}
    provenance = metadata.get("provenance", {})
    return {"name": path.stem, "licence": metadata.get("licence"), "size": _size(path), **provenance}


def _of_people(path: Path) -> dict[str, Any]:
    """A network that was trained on whole synthetic people; its licence says whose shapes they have."""
    found = _checkpoint(path)
    return {name: value for name, value in found.items() if name in ("name", "licence", "size")}


def _extra_models() -> dict[str, str]:
    """The models of the extra `dlib`, which may not be used commercially."""
    try:
        return {
            "licence": PREDICTOR_LICENCE,
            "size": _size(predictor_path()),
            "recognition": RECOGNITION_LICENCE,
        }
    except FacerfError:
        return {"name": "not installed (an extra, see above)"}


def _colour_configuration() -> dict[str, Any]:
    configuration = oiio.ColorConfig()
    trouble = configuration.geterror()
    if trouble:
        raise FacerfError(f"$OCIO is {os.environ.get('OCIO', '')!r}: {trouble}")
    return {"OCIO": configuration.configname(), "spaces": configuration.getNumColorSpaces()}


def _size(path: Path) -> str:
    return f"{path.stat().st_size / 2**20:.1f} MiB"
