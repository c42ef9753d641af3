"""Environment maps that a user brings."""

from pathlib import Path

import torch
from torch import Tensor

from facerf_cli.errors import InputError
from facerf_cli.files.images import ENVMAP_LIMIT_PX, read_image
from facerf_cli.light.envmap import check_envmap


def read_map_file(path: Path | str) -> Tensor:
    """A lat-long map [H, W, 3], linear Rec.709; an InputError says what is wrong with it."""
    envmap = torch.from_numpy(read_image(path, limit_px=ENVMAP_LIMIT_PX).pixels)
    try:
        check_envmap(envmap)
    except InputError as error:
        raise InputError(f"{path}: {error}") from None
    return envmap
