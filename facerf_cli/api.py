"""Read and write images as arrays: the part of the Python API that concerns files."""

from pathlib import Path
from typing import Literal

import numpy as np
from torch import Tensor

from facerf_cli.files import read, write
from facerf_cli.light.light import Array


def read_image(path: str | Path, colourspace: str | None = None) -> np.ndarray:
    """Read an image or a map as scene-linear Rec.709, float32 [H, W, 3].

    Args:
        path: Any image file that `facerf relight` accepts.
        colourspace: Name of a colour space that overrides the file's.

    Raises:
        InputError: The file is not a readable image.
    """
    return read.read_image(Path(path), colourspace).pixels


def write_image(path: str | Path, pixels: Array, exposure: float | Literal["auto"] = 0.0) -> None:
    """Write a scene-linear image as EXR, or exposed as 8-bit PNG or JPEG; the suffix selects the format.

    Args:
        path: The file to write.
        pixels: Image [H, W, 3], or [H, W, 4] with straight alpha.
        exposure: Exposure of PNG and JPEG in EV; "auto" exposes the whole image.
    """
    values = pixels.detach().cpu().numpy() if isinstance(pixels, Tensor) else pixels
    if values.ndim != 3 or values.shape[2] not in (3, 4):
        raise ValueError(f"pixels have shape {list(values.shape)}, not [H, W, 3] or [H, W, 4]")
    path, colour = Path(path), np.ascontiguousarray(values[..., :3], np.float32)
    alpha = values[..., 3] if values.shape[-1] == 4 else None
    if path.suffix.lower() == ".exr":
        write.write_exr(path, colour, alpha)
    else:
        write.write_display(path, colour, exposure, alpha)
