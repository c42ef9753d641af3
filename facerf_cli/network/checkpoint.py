"""Checkpoints: safetensors files of networks, with configuration, provenance and metrics as JSON metadata.

Tensors are named `<network>.<tensor>`; the metadata holds the form and the settings of each network. No
pickle is loaded.
"""

import json
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch import Tensor, nn
from torch.overrides import TorchFunctionMode

from facerf_cli.errors import InputError
from facerf_cli.files.atomic import atomic_path
from facerf_cli.network.appearance_network import AppearanceNetwork
from facerf_cli.network.diffuse_sh import DiffuseNetwork
from facerf_cli.network.feature_networks import LightNetwork
from facerf_cli.network.files import FORMAT, read_metadata
from facerf_cli.network.geometry import GeometryNetwork
from facerf_cli.network.parsing import ParsingNetwork
from facerf_cli.network.portrait import PortraitNetwork
from facerf_cli.network.reflectance import REFLECTANCE_FORMS
from facerf_cli.run import memory

_FILLS = (Tensor.uniform_, Tensor.normal_)
_COPIES = 3  # of a file: its tensors, floats of its halves, and the networks that take them

# Classes by the name of a network in a checkpoint, and its form.
_CLASSES: dict[tuple[str, str], type[Any]] = {
    **{("reflectance", form): network for form, network in REFLECTANCE_FORMS.items()},
    ("geometry", "default"): GeometryNetwork,
    ("geometry", "paper"): GeometryNetwork,
    ("light_features", "vgg"): LightNetwork,
    ("appearance_features", "vgg"): AppearanceNetwork,
    ("diffuse_sh", "default"): DiffuseNetwork,
    ("parsing", "default"): ParsingNetwork,
    ("portrait", "default"): PortraitNetwork,
}


def save_networks(path: Path, networks: Mapping[str, nn.Module], metadata: dict[str, Any]) -> None:
    """Write networks by name, with their form and settings and further metadata."""
    tensors = {f"{name}.{key}": t for name, net in networks.items() for key, t in net.state_dict().items()}
    described = {name: network.as_metadata() for name, network in networks.items()}  # type: ignore[operator]
    save_checkpoint(path, tensors, {"networks": described, **metadata})


def load_networks(
    path: Path, layout_version: int, names: Collection[str] | None = None
) -> tuple[dict[str, nn.Module], dict[str, Any]]:
    """Read the networks of a checkpoint, or those of some names, on the CPU, and its metadata.

    Raises InputError if it is not a checkpoint of this UV layout and of this version's networks.
    """
    tensors, metadata = load_checkpoint(path)
    if metadata.get("layout_version") != layout_version:
        raise InputError(f"{path}: trained for another UV layout; train it again with this version of facerf")
    try:
        networks = {
            name: _restore(name, described, _tensors_of(tensors, name))
            for name, described in metadata["networks"].items()
            if names is None or name in names
        }
    except (LookupError, ArithmeticError, TypeError, RuntimeError, ValueError, AttributeError):
        raise InputError(f"{path}: its weights do not fit this version's network; train it again") from None
    return networks, metadata


def save_checkpoint(path: Path, tensors: dict[str, Tensor], metadata: dict[str, Any]) -> None:
    """Write tensors (floats in half precision) and metadata; the file appears whole or not at all."""
    stored = {k: (t.half() if t.is_floating_point() else t).contiguous().cpu() for k, t in tensors.items()}
    with atomic_path(path) as temporary:
        temporary.write_bytes(save(stored, {"format": FORMAT, "facerf": json.dumps(metadata)}))


def load_checkpoint(path: Path) -> tuple[dict[str, Tensor], dict[str, Any]]:
    """Read tensors (floats in single precision) and metadata; raises InputError for any other file."""
    metadata = read_metadata(path)
    try:
        memory.require(str(path), _COPIES * path.stat().st_size, "a smaller checkpoint")
        with safe_open(path, framework="pt") as file:
            tensors = {key: file.get_tensor(key) for key in file.keys()}  # noqa: SIM118 (not a dict)
        if not all(tensor.isfinite().all() for tensor in tensors.values()):
            raise ValueError("it holds values that are not finite")
    except (SafetensorError, OSError, ValueError, RuntimeError) as error:
        raise InputError(
            f"{path}: not a facerf checkpoint ({error}); give a file that `facerf train` wrote"
        ) from None
    return {k: (t.float() if t.dtype == torch.float16 else t) for k, t in tensors.items()}, metadata


def _restore(name: str, described: dict[str, Any], tensors: dict[str, Tensor]) -> nn.Module:
    """Make the network that metadata describe and load its tensors; raises ValueError if they do not fit."""
    network_class = _CLASSES[name, described["form"]]
    with torch.device("meta"), _Unfilled():  # takes no memory, whatever sizes the file demands
        shapes = network_class.from_metadata(described).state_dict().items()
        expected = {key: tensor.shape for key, tensor in shapes}
    if expected != {key: tensor.shape for key, tensor in tensors.items()}:
        raise ValueError(f"{name}: the sizes of its tensors are not those of its settings")
    with _Unfilled():
        network: nn.Module = network_class.from_metadata(described)
    network.load_state_dict(tensors)
    # processors convolve faster so, and graphics cards no slower
    return network.to(memory_format=torch.channels_last)  # type: ignore[call-overload]


class _Unfilled(TorchFunctionMode):
    """Leaves out the first values of weights, which those of a checkpoint replace.

    On the device meta, drawing them would import most of torch's compiler.
    """

    def __torch_function__(
        self, function: Any, types: Any, args: tuple[Any, ...] = (), kwargs: dict[str, Any] | None = None
    ) -> Any:
        """Call a function of torch, unless it fills a tensor."""
        kwargs = kwargs or {}
        if function in _FILLS or getattr(function, "__module__", "") == nn.init.__name__:
            return args[0] if args else kwargs["tensor"]
        return function(*args, **kwargs)


def _tensors_of(tensors: dict[str, Tensor], name: str) -> dict[str, Tensor]:
    prefix = f"{name}."
    return {key.removeprefix(prefix): t for key, t in tensors.items() if key.startswith(prefix)}
