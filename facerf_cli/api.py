"""The Python API: what a notebook calls (docs/python.md); the pipeline does the work.

Images are scene-linear Rec.709, float32 [H, W, 3], of numpy or torch; angles in degrees; the units of light
are those of the command line (docs/design.md).
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from torch import Tensor

from facerf_cli.errors import UsageError
from facerf_cli.files import read, write
from facerf_cli.light.light import Array, Light, rig
from facerf_cli.network.files import checkpoint_file
from facerf_cli.person import Group, Person, PhotoCamera, find_faces, fit
from facerf_cli.relighting.models import Models
from facerf_cli.relighting.models import load_models as load

__all__ = [
    "Group",
    "Light",
    "Person",
    "PhotoCamera",
    "find_faces",
    "fit",
    "load_models",
    "read_image",
    "rig",
    "write_image",
]


def read_image(path: str | Path, colourspace: str | None = None) -> np.ndarray:
    """Read an image or a map as scene-linear Rec.709 [H, W, 3]; `colourspace` overrides the file's."""
    return read.read_image(Path(path), colourspace).pixels


def write_image(path: str | Path, pixels: Array, exposure: float | Literal["auto"] = 0.0) -> None:
    """Write [H, W, 3] or [H, W, 4] as EXR, or at an exposure in EV as 8-bit PNG or JPEG, by the suffix."""
    values = pixels.detach().cpu().numpy() if isinstance(pixels, Tensor) else pixels
    if values.ndim != 3 or values.shape[2] not in (3, 4):
        raise ValueError(f"pixels have shape {list(values.shape)}, not [H, W, 3] or [H, W, 4]")
    path, colour = Path(path), np.ascontiguousarray(values[..., :3], np.float32)
    alpha = values[..., 3] if values.shape[-1] == 4 else None
    if path.suffix.lower() == ".exr":
        write.write_exr(path, colour, alpha)
    else:
        write.write_display(path, colour, exposure, alpha)


def load_models(
    checkpoint: str | Path | Sequence[str | Path] | None = None,
    face_model: str | Path = "builtin",
    device: str | torch.device = "cpu",
    form: str | None = None,
) -> Models:
    """Load networks (None: the shipped ones) and a face model; `device` is cpu, cuda, cuda:1, mps.

    Of several checkpoints, or runs' folders, each serves the networks that its last training trained.
    `form` is package.module:Class, an installed class of a Reflectance Network of your own.
    """
    try:
        torch.empty(0, device=device)
    except (RuntimeError, AssertionError):
        raise UsageError(f"device {device}: torch finds no such device; give cpu, cuda or mps") from None
    given = [checkpoint] if isinstance(checkpoint, (str, Path)) else checkpoint or ()
    return load([checkpoint_file(Path(path)) for path in given], face_model, torch.device(device), form)
