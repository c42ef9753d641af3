"""The device, assets, colour configuration and cache that `facerf doctor` shows."""

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import OpenImageIO as oiio
import platformdirs
import torch

from facerf_cli.batch.settings import Settings, torch_device
from facerf_cli.errors import FacerfError
from facerf_cli.face.descriptor import LICENCE as DESCRIPTOR_LICENCE
from facerf_cli.face.descriptor import descriptor_path
from facerf_cli.face.morphable import BUILTIN_PATH
from facerf_cli.network.checkpoint import load_checkpoint
from facerf_cli.network.files import SHIPPED, serving_files
from facerf_cli.network.stored_graph import ASSET
from facerf_cli.network.stored_graph import LICENCE as MEDIAPIPE_LICENCE
from facerf_cli.relighting.models import described_file
from facerf_cli.run.machine import memory_bytes
from facerf_cli.work.installed import MISSING


def examine(settings: Settings) -> dict[str, dict[str, Any]]:
    """The facts of this machine by section."""
    try:
        serving = serving_files(settings.checkpoints, user="facerf")
        networks: dict[str, Any] = {name: described_file(path) for name, path in serving.items()}
    except FacerfError as error:
        serving, networks = SHIPPED, {MISSING: {"file": str(error), "sha256": ""}}
    return {
        "device": _device(settings),
        "assets": {
            "face model": _face_model(BUILTIN_PATH),
            **_checkpoints(serving),
            "mediapipe": {"licence": MEDIAPIPE_LICENCE, "size": _size(ASSET)},
            "dlib": _extra_model(),
        },
        "networks": networks,
        "colour": _colour_configuration(),
        "cache": {"folder": platformdirs.user_cache_dir("facerf")},
    }


def _device(settings: Settings) -> dict[str, Any]:
    device = torch_device(settings)
    built = f"built for CUDA {torch.version.cuda}" if torch.version.cuda else "built without CUDA"
    name = torch.cuda.get_device_name(device) if device.type == "cuda" else f"this torch is {built}"
    return {
        "uses": f"{device} ({name})",
        "threads": torch.get_num_threads(),
        "memory": f"{memory_bytes() / 2**30:.0f} GiB",
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


def _checkpoints(serving: Mapping[str, Path]) -> dict[str, dict[str, Any]]:
    """The checkpoints whose licences are shown; those of people say whose shapes these have."""
    people = ("name", "licence", "size")
    return {"checkpoint": _checkpoint(serving["reflectance"])} | {
        name: {key: value for key, value in _checkpoint(serving[name]).items() if key in people}
        for name in ("parsing", "portrait")
    }


def _checkpoint(path: Path) -> dict[str, Any]:
    try:
        _, metadata = load_checkpoint(path)
    except FacerfError as error:
        return {"name": f"{MISSING}: {error}"}
    provenance = metadata.get("provenance", {})
    return {"name": path.stem, "licence": metadata.get("licence"), "size": _size(path), **provenance}


def _extra_model() -> dict[str, str]:
    try:
        return {"licence": DESCRIPTOR_LICENCE, "size": _size(descriptor_path())}
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
