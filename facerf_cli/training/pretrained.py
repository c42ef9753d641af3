"""Feature networks of the losses: V_f, published or trained here, and S_f."""

import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal

import torch
from safetensors.torch import load_file

from facerf_cli.errors import InputError, UsageError
from facerf_cli.face.topology import LAYOUT_VERSION
from facerf_cli.files.downloads import PublishedFile, fetch
from facerf_cli.network.checkpoint import load_networks
from facerf_cli.network.feature_networks import VggFeatures

# torchvision's IMAGENET1K_V1; its file name contains the first eight digits of the digest.
VGG16 = PublishedFile(
    "https://download.pytorch.org/models/vgg16-397923af.pth",
    sha256="397923af8e79cdbb6a7127f12361acd7a2f83e06b05044ddf496e83de57a5bf0",
    size_limit=600 * 2**20,  # the file has 553433881 bytes
)
VGG16_LICENCE = (
    "VGG-16: torchvision (BSD-3-Clause), trained on ImageNet (pictures for non-commercial research)"
)
FeatureName = Literal["light_features", "appearance_features"]
_VGG_ADVICE = "give --vgg-weights imagenet, or a .pth or .safetensors of torchvision's vgg16-397923af"
_LARGEST_FILE = 2**30  # bytes; guards against archives that unpack to far more


def load_vgg(choice: str | Path | None, network: VggFeatures | None = None) -> VggFeatures:
    """Load V_f, frozen, for a value of `--vgg-weights`: 'imagenet', or a .pth or .safetensors of VGG-16.

    'imagenet' is downloaded once and verified; a file must have torchvision's names. Pickles are read with
    `weights_only`. None raises UsageError. `network`, if given, gets the weights instead of a new V_f.
    """
    if choice is None:
        raise UsageError(
            "--vgg-weights: missing, and the feature loss needs VGG-16; give --vgg-weights imagenet "
            "(downloads 528 MiB once), or --vgg-weights PATH of torchvision's vgg16-397923af.pth; training "
            "also takes --appearance-features FILE"
        )
    path = fetch(VGG16, "--vgg-weights PATH") if str(choice) == "imagenet" else Path(choice)
    network = VggFeatures() if network is None else network
    try:
        network.load_published(read_tensors(path, _VGG_ADVICE))
    except ValueError as error:
        raise InputError(f"{path}: not VGG-16 with torchvision's names ({error}); {_VGG_ADVICE}") from None
    network.eval().requires_grad_(False)
    return network


def load_features(path: Path, name: FeatureName, side: int | None = None) -> Any:
    """Load S_f ('light_features') or V_f ('appearance_features'), frozen, from a checkpoint of its stage.

    Raises InputError where it was not trained on images of `side`: features of another scale mislead a loss.
    """
    network: Any = load_networks(path, LAYOUT_VERSION)[0].get(name)
    stage = name.replace("_", "-")
    if network is None:
        raise InputError(f"{path}: has no network {name}; give one of `facerf train --stage {stage}`")
    trained = network.settings.side
    if side is not None and trained != side:
        raise InputError(
            f"{path}: its network {name} was trained on images of {trained} px, here they have {side}; train "
            f"it with --stage {stage} --texture-size {side}, or give --texture-size {trained} here"
        )
    network.eval().requires_grad_(False)
    return network


def read_tensors(path: Path, advice: str) -> Mapping[str, Any]:
    """Read the tensors of a .pth or .safetensors by name; raise ValueError where it is neither.

    A missing file raises InputError, which ends with `advice`.
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
    """Bytes of a file, or of its content if it is a .zip archive, as torch's newer files are."""
    size = path.stat().st_size
    try:
        with zipfile.ZipFile(path) as archive:
            return max(size, sum(member.file_size for member in archive.infolist()))
    except (zipfile.BadZipFile, OSError, ValueError, NotImplementedError):
        return size
