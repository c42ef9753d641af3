"""LPIPS where its weights are at hand: VGG-16's, and its own heads from a file or the package `lpips`."""

import hashlib
from collections.abc import Callable
from functools import cache
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import torch

from facerf_cli.colour import srgb_to_linear
from facerf_cli.errors import InputError, UsageError
from facerf_cli.network.perceptual import SMALLEST_PX, Lpips
from facerf_cli.objectives.feature_networks import load_vgg, read_tensors

LPIPS_LICENCE = "LPIPS v0.1, VGG heads: BSD 2-Clause, Zhang et al. (package lpips)"
_PACKAGE, _FILE = "lpips", "weights/v0.1/vgg.pth"
_ADVICE = "--lpips takes lpips/weights/v0.1/vgg.pth of the package lpips"
# Of the heads' values one after another, float32 little-endian. Version 0.0 has the same names and shapes.
_DIGEST = "9153a2043dccf3b525d4f13db916e93ef040548ea923b6f2100de5ebac141a78"


@cache
def perceptual_metric(
    heads: Path | None, vgg_weights: str | Path | None
) -> Callable[[np.ndarray, np.ndarray], float]:
    """LPIPS of two sRGB pictures [H, W, 3] in 0..1, loaded once a process.

    `heads` as `--lpips` has it (None: the installed package's), `vgg_weights` as `--vgg-weights`.
    """
    if vgg_weights is None:
        raise UsageError(
            "--lpips needs the weights of VGG-16, too: give --vgg-weights imagenet (fetches 528 MiB once), "
            "or --vgg-weights PATH of torchvision's vgg16-397923af.pth"
        )
    network = Lpips()
    _load_heads(network, heads or _bundled_heads())
    load_vgg(vgg_weights, network.trunk)
    network.eval().requires_grad_(False)

    def distance(ours_srgb: np.ndarray, true_srgb: np.ndarray) -> float:
        if min(true_srgb.shape[:2]) < SMALLEST_PX:
            raise InputError(f"LPIPS needs pictures of {SMALLEST_PX} px a side; leave --vgg-weights out")
        both = srgb_to_linear(np.stack([ours_srgb, true_srgb]))
        tensors = torch.from_numpy(both).permute(0, 3, 1, 2)
        return float(network(tensors[:1], tensors[1:]))

    return distance


def _bundled_heads() -> Path:
    """The heads' file of the package `lpips`, which is not imported: it needs torchvision."""
    spec = find_spec(_PACKAGE)
    path = Path(spec.origin).parent / _FILE if spec and spec.origin else None
    if path is None or not path.is_file():
        raise UsageError(f"LPIPS needs its own weights: install the package {_PACKAGE}, or {_ADVICE}")
    return path


def _load_heads(network: Lpips, path: Path) -> None:
    try:
        network.load_heads(read_tensors(path, _ADVICE))
    except ValueError as error:
        raise InputError(f"{path}: no heads of LPIPS on VGG: {error}") from None
    if _digest(network) != _DIGEST:
        raise InputError(f"{path}: not the published heads of LPIPS v0.1 on VGG; {_ADVICE}")


def _digest(network: Lpips) -> str:
    values = torch.cat([head.detach().flatten() for head in network.heads]).numpy().astype("<f4")
    return hashlib.sha256(values.tobytes()).hexdigest()
