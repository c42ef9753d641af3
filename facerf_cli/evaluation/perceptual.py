"""LPIPS, if its weights are there: VGG-16's, and its own heads from a file or from the package `lpips`."""

import hashlib
from collections.abc import Callable
from functools import cache
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import torch

from facerf_cli.colour import srgb_to_linear
from facerf_cli.errors import InputError, UsageError
from facerf_cli.network.feature_networks import SMALLEST_PX, Lpips
from facerf_cli.training.pretrained import load_vgg, read_tensors

_PACKAGE, _FILE = "lpips", "weights/v0.1/vgg.pth"  # Zhang et al., LPIPS v0.1, BSD 2-Clause
_ADVICE = "give --lpips lpips/weights/v0.1/vgg.pth of the package lpips"
# SHA-256 of the heads' values, float32 little-endian. Version 0.0 has heads of the same names and shapes.
_DIGEST = "9153a2043dccf3b525d4f13db916e93ef040548ea923b6f2100de5ebac141a78"


@cache
def perceptual_metric(
    heads: Path | None, vgg_weights: str | Path | None
) -> Callable[[np.ndarray, np.ndarray], float]:
    """Load LPIPS of two sRGB images [H, W, 3] in 0..1, once a process.

    `heads` is the file of `--lpips` (None: that of the installed package), `vgg_weights` the value of
    `--vgg-weights`. Raises UsageError or InputError for weights that are missing or others.
    """
    if vgg_weights is None:
        raise UsageError(
            "--lpips: needs the weights of VGG-16; give --vgg-weights imagenet (downloads 528 MiB once), or "
            "--vgg-weights PATH of torchvision's vgg16-397923af.pth"
        )
    network = Lpips()
    _load_heads(network, heads or _installed_heads())
    load_vgg(vgg_weights, network.trunk)
    network.eval().requires_grad_(False)

    def distance(prediction_srgb: np.ndarray, truth_srgb: np.ndarray) -> float:
        if min(truth_srgb.shape[:2]) < SMALLEST_PX:
            raise InputError(f"LPIPS: needs images of {SMALLEST_PX} px a side; leave --vgg-weights out")
        both = srgb_to_linear(np.stack([prediction_srgb, truth_srgb]))
        tensors = torch.from_numpy(both).permute(0, 3, 1, 2)
        return float(network(tensors[:1], tensors[1:]))

    return distance


def _installed_heads() -> Path:
    """Find the heads' file of the package `lpips` without importing it, since that needs torchvision."""
    spec = find_spec(_PACKAGE)
    path = Path(spec.origin).parent / _FILE if spec and spec.origin else None
    if path is None or not path.is_file():
        raise UsageError(f"LPIPS: its own weights are missing; install the package {_PACKAGE}, or {_ADVICE}")
    return path


def _load_heads(network: Lpips, path: Path) -> None:
    try:
        network.load_heads(read_tensors(path, _ADVICE))
    except ValueError as error:
        raise InputError(f"{path}: no heads of LPIPS on VGG ({error}); {_ADVICE}") from None
    if _digest(network) != _DIGEST:
        raise InputError(f"{path}: not the published heads of LPIPS v0.1 on VGG; {_ADVICE}")


def _digest(network: Lpips) -> str:
    values = torch.cat([head.detach().flatten() for head in network.heads]).numpy().astype("<f4")
    return hashlib.sha256(values.tobytes()).hexdigest()
