"""Checkpoints: safetensors with their configuration, provenance and metrics as JSON metadata. No pickle."""

import json
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch import Tensor

from facerf_cli.errors import InputError
from facerf_cli.files.atomic import atomic_path

FORMAT = "facerf-checkpoint-1"


def save_checkpoint(path: Path, tensors: dict[str, Tensor], metadata: dict[str, Any]) -> None:
    """Write tensors (floats in half precision) and metadata through a temporary name."""
    stored = {k: (t.half() if t.is_floating_point() else t).contiguous().cpu() for k, t in tensors.items()}
    with atomic_path(path) as temporary:
        temporary.write_bytes(save(stored, {"format": FORMAT, "facerf": json.dumps(metadata)}))


def load_checkpoint(path: Path) -> tuple[dict[str, Tensor], dict[str, Any]]:
    """Tensors (floats in single precision) and metadata of a checkpoint that `facerf train` wrote."""
    if not path.is_file():
        raise InputError(f"{path}: no such checkpoint; give a .safetensors file that `facerf train` wrote")
    try:
        with safe_open(path, framework="pt") as file:
            header = file.metadata() or {}
            tensors = {key: file.get_tensor(key) for key in file.keys()}  # noqa: SIM118 (not a dict)
        metadata = json.loads(header["facerf"])
        if not isinstance(metadata, dict):
            raise ValueError("its metadata is no JSON object")
        if not all(tensor.isfinite().all() for tensor in tensors.values()):
            raise ValueError("it holds values that are not finite")
    except (SafetensorError, OSError, KeyError, ValueError) as error:
        raise InputError(
            f"{path}: not a facerf checkpoint ({error}); give a file that `facerf train` wrote"
        ) from None
    if header.get("format") != FORMAT:
        raise InputError(f"{path}: written by another version of facerf; train or fetch the checkpoint again")
    return {k: (t.float() if t.dtype == torch.float16 else t) for k, t in tensors.items()}, metadata
