"""MakeHuman's upper body, garments, hat and hand (CC0), packed by `examples/pack_makehuman.py`."""

from functools import lru_cache
from importlib.resources import files

import numpy as np
from safetensors.numpy import load

MAKEHUMAN_LICENCE = "bodies and clothes: CC0 1.0 (MakeHuman)"
STEP_M = 2e-5  # unit of the stored coordinates
GARMENTS = (
    "tee",
    "loose tee",
    "v-neck",
    "round neck",
    "blouse",
    "sweater",
    "polo",
    "shirt",
    "jacket",
    "suit",
)


def packed_mesh(name: str) -> tuple[np.ndarray, np.ndarray]:
    """Vertices [V, 3] (m, the middle of the neck at the origin) and triangles [F, 3] of a packed shape."""
    tensors = _tensors()
    vertices = tensors[f"{name}.vertices"].astype(np.float64) * STEP_M
    return vertices, tensors[f"{name}.triangles"].astype(np.int64)


@lru_cache(maxsize=1)
def _tensors() -> dict[str, np.ndarray]:
    return load(files("facerf_cli.assets").joinpath("makehuman.safetensors").read_bytes())
