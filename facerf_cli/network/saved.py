"""Networks in a checkpoint: tensors `<name>.<tensor>`, and the form and settings of each in the metadata."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from facerf_cli.errors import InputError
from facerf_cli.files.checkpoints import load_checkpoint, save_checkpoint
from facerf_cli.network.diffuse import DiffuseNetwork
from facerf_cli.network.features import LightNetwork
from facerf_cli.network.geometry import GeometryNetwork
from facerf_cli.network.paper_reflectance import PaperReflectanceNetwork
from facerf_cli.network.reflectance import ReflectanceNetwork

_LARGEST_SIDE = 4096
FORMS: dict[tuple[str, str], type[Any]] = {  # by what a network is for, and its form
    ("reflectance", "default"): ReflectanceNetwork,
    ("reflectance", "paper"): PaperReflectanceNetwork,
    ("geometry", "default"): GeometryNetwork,
    ("geometry", "paper"): GeometryNetwork,
    ("light_features", "vgg"): LightNetwork,
    ("diffuse_sh", "default"): DiffuseNetwork,
}


def save_networks(path: Path, networks: Mapping[str, nn.Module], metadata: dict[str, Any]) -> None:
    """Write networks by name with their metadata, and what else there is to say."""
    tensors = {f"{name}.{key}": t for name, net in networks.items() for key, t in net.state_dict().items()}
    described = {name: network.as_metadata() for name, network in networks.items()}  # type: ignore[operator]
    save_checkpoint(path, tensors, {"networks": described, **metadata})


def load_networks(path: Path, layout_version: int) -> tuple[dict[str, nn.Module], dict[str, Any]]:
    """The networks of a checkpoint by name, on the CPU, and its metadata; InputError if they do not fit."""
    tensors, metadata = load_checkpoint(path)
    if metadata.get("layout_version") != layout_version:
        raise InputError(f"{path}: trained for another UV layout; train it again with this version of facerf")
    try:
        networks = {
            name: _built(name, described, _part(tensors, name))
            for name, described in metadata["networks"].items()
        }
    except (LookupError, ArithmeticError, TypeError, RuntimeError, ValueError, AttributeError):
        raise InputError(f"{path}: its weights do not fit this version's network; train it again") from None
    return networks, metadata


def _built(name: str, described: dict[str, Any], tensors: dict[str, Tensor]) -> nn.Module:
    form = FORMS[name, described["form"]]
    _require_sane(described)
    with torch.device("meta"):  # takes no memory, whatever sizes the file asks for
        expected = {key: tensor.shape for key, tensor in form.from_metadata(described).state_dict().items()}
    if expected != {key: tensor.shape for key, tensor in tensors.items()}:
        raise ValueError(f"{name}: the sizes of its tensors are not those of its settings")
    network: nn.Module = form.from_metadata(described)
    network.load_state_dict(tensors)
    return network


def _require_sane(described: dict[str, Any]) -> None:
    """Raise ValueError for settings that no tensor's shape would betray."""
    side, normals = described.get("side", 128), described.get("normals", True)
    if type(side) is not int or not 8 <= side <= _LARGEST_SIDE or type(normals) is not bool:
        raise ValueError(f"a working side of {side}, normals {normals}")


def _part(tensors: dict[str, Tensor], name: str) -> dict[str, Tensor]:
    prefix = f"{name}."
    return {key.removeprefix(prefix): t for key, t in tensors.items() if key.startswith(prefix)}
