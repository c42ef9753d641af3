"""Where a loss has its feature networks from: V_f from `--vgg-weights`, S_f from `--light-features`."""

import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from safetensors.torch import load_file

from facerf_cli.errors import InputError, UsageError
from facerf_cli.face.topology import LAYOUT_VERSION
from facerf_cli.files.downloads import Published, fetch
from facerf_cli.network.checkpoint import load_networks
from facerf_cli.network.feature_networks import LightNetwork, VggFeatures

# torchvision's IMAGENET1K_V1. The name carries the digest's first eight digits.
VGG16 = Published(
    "https://download.pytorch.org/models/vgg16-397923af.pth",
    sha256="397923af8e79cdbb6a7127f12361acd7a2f83e06b05044ddf496e83de57a5bf0",
    size_limit=600 * 2**20,  # it has 553433881 bytes
)
VGG16_LICENCE = (
    "VGG-16: torchvision (BSD-3-Clause), trained on ImageNet (pictures for non-commercial research)"
)
_LARGEST_FILE = 2**30


def load_vgg(choice: str | Path | None, network: VggFeatures | None = None) -> VggFeatures:
    """V_f, frozen, from what `--vgg-weights` was given: 'imagenet', or a .pth or .safetensors of VGG-16.

    `network` is filled instead of V_f where it is given.

    'imagenet' is fetched once and verified; a path is taken as it is, with torchvision's names. Pickles are
    read with `weights_only`. None stops with words that help: a feature loss was asked for without weights.
    """
    if choice is None:
        raise UsageError(
            "this preset's feature loss compares features of VGG-16: give --vgg-weights imagenet (fetches "
            "528 MiB once), or --vgg-weights PATH of torchvision's vgg16-397923af.pth"
        )
    path = fetch(VGG16, "--vgg-weights PATH") if str(choice) == "imagenet" else Path(choice)
    network = VggFeatures() if network is None else network
    try:
        network.load_published(read_tensors(path, "--vgg-weights takes 'imagenet' or a .pth or .safetensors"))
    except ValueError as error:
        raise InputError(f"{path}: no weights of VGG-16 by torchvision's names: {error}") from None
    network.eval().requires_grad_(False)
    return network


def load_light_features(path: Path) -> LightNetwork:
    """S_f, frozen, from a checkpoint that `facerf train --stage light-features` wrote."""
    network = load_networks(path, LAYOUT_VERSION)[0].get("light_features")
    if not isinstance(network, LightNetwork):
        raise InputError(f"{path}: holds no S_f; give one by `facerf train --stage light-features`")
    network.eval().requires_grad_(False)
    return network


def read_tensors(path: Path, advice: str) -> Mapping[str, Any]:
    """What a .pth or .safetensors holds, by name; ValueError in words where it is neither.

    No such file is an InputError that ends with the advice.
    """
    if not path.is_file():
        raise InputError(f"{path}: no such file; {advice}")
    if _unpacked_size(path) > _LARGEST_FILE:
        raise ValueError(f"larger than {_LARGEST_FILE / 2**20:.0f} MiB")
    try:
        if path.suffix == ".safetensors":
            return load_file(path)
        tensors = torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:  # whatever a broken or hostile file makes its reader raise
        raise ValueError(f"cannot be read as tensors ({type(error).__name__})") from None
    if not isinstance(tensors, Mapping):
        raise ValueError("it holds no tensors by name")
    return tensors


def _unpacked_size(path: Path) -> int:
    """Bytes of a file, or of what it unpacks to where it is a .zip, as torch's newer files are."""
    size = path.stat().st_size
    try:
        with zipfile.ZipFile(path) as archive:
            return max(size, sum(member.file_size for member in archive.infolist()))
    except (zipfile.BadZipFile, OSError, ValueError, NotImplementedError):
        return size
