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
from safetensors.torch import load_file, save
from torch import Tensor, nn
from torch.overrides import TorchFunctionMode

from facerf_cli.errors import InputError, UsageError
from facerf_cli.files.atomic import atomic_path
from facerf_cli.network.diffuse_sh import DiffuseNetwork
from facerf_cli.network.features import AppearanceNetwork, LightNetwork
from facerf_cli.network.files import FORMAT, read_metadata, title_of
from facerf_cli.network.geometry import GeometryNetwork
from facerf_cli.network.installed import installed, is_installed_name
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


def use_form(form: str | None) -> None:
    """Let checkpoints hold Reflectance Networks of a form package.module:Class that the user has installed.

    Names of facerf's own forms change nothing. Raises UsageError where there is no such class.
    """
    if form and is_installed_name(form):
        _CLASSES["reflectance", form] = installed(form, "--form")


def form_of(name: str, form: str) -> str:
    """The form of facerf's that a class of the user's extends, with its settings; else the form itself."""
    own = _CLASSES.get((name, form))
    if own is None or not is_installed_name(form):
        return form
    for (network, known), kind in _CLASSES.items():
        if network == name and not is_installed_name(known) and issubclass(own, kind):
            return known if issubclass(own.kind_of_settings, kind.kind_of_settings) else form
    return form


def _described(network: Any) -> dict[str, Any]:
    """Form and settings of a network; a class that the user has installed does not know its name."""
    forms = (form for (_, form), known in _CLASSES.items() if known is type(network))
    own = next(filter(is_installed_name, forms), None)
    if type(network) not in _CLASSES.values():
        raise UsageError(f"{type(network).__name__}: no class of facerf's own; call use_form with its name")
    return {**network.as_metadata(), **({"form": own} if own else {})}


def new_network(name: str, form: str, settings: Mapping[str, Any]) -> Any:
    """Make an untrained network of a form; settings that are missing have their defaults.

    Raises UsageError for an unknown form, TypeError or ValueError for settings that it does not have.
    """
    forms = [known for network, known in _CLASSES if network == name]
    if form not in forms:
        raise UsageError(f"form {form}: no such {title_of(name)}; give one of {', '.join(forms)}")
    return _CLASSES[name, form].from_metadata({"form": form, **settings})


def save_networks(path: Path, networks: Mapping[str, nn.Module], metadata: dict[str, Any]) -> None:
    """Write networks by name, with their form and settings and further metadata."""
    tensors = {f"{name}.{key}": t for name, net in networks.items() for key, t in net.state_dict().items()}
    described = {name: _described(network) for name, network in networks.items()}
    save_checkpoint(path, tensors, {"networks": described, **metadata}, half=False)


def load_networks(
    path: Path, layout_version: int, names: Collection[str] | None = None
) -> tuple[dict[str, nn.Module], dict[str, Any]]:
    """Read the networks of a checkpoint, or those of some names, on the CPU, and its metadata.

    Raises InputError if it is not a checkpoint of this UV layout and of this version's networks, or of one
    of the user's own that `use_form` does not know. Nothing is imported because a file names it.
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
    except UsageError as error:
        raise InputError(f"{path}: {error}") from None
    except (LookupError, ArithmeticError, TypeError, RuntimeError, ValueError, AttributeError):
        raise InputError(f"{path}: its weights do not fit this version's network; train it again") from None
    return networks, metadata


def save_checkpoint(
    path: Path, tensors: dict[str, Tensor], metadata: dict[str, Any], half: bool = True
) -> None:
    """Write tensors (with `half` floats in half precision) and metadata, whole or not at all."""
    stored = {
        k: (t.half() if half and t.is_floating_point() else t).contiguous().cpu() for k, t in tensors.items()
    }
    with atomic_path(path) as temporary:
        temporary.write_bytes(save(stored, {"format": FORMAT, "facerf": json.dumps(metadata)}))


def load_checkpoint(path: Path) -> tuple[dict[str, Tensor], dict[str, Any]]:
    """Read tensors (floats in single precision) and metadata; raises InputError for any other file."""
    metadata = read_metadata(path)
    try:
        memory.require(str(path), _COPIES * path.stat().st_size, "a smaller checkpoint")
        with safe_open(path, framework="pt") as file:
            tensors = {key: file.get_tensor(key) for key in file.keys()}  # noqa: SIM118 (not a dict)
        tensors = {k: (t.float() if t.dtype == torch.float16 else t) for k, t in tensors.items()}
        if not all(tensor.sum().isfinite() for tensor in tensors.values()):
            raise ValueError("it holds values that are not finite")
    except (SafetensorError, OSError, ValueError, RuntimeError) as error:
        raise InputError(
            f"{path}: not a facerf checkpoint ({error}); give a file that `facerf train` wrote"
        ) from None
    return tensors, metadata


def _restore(name: str, described: dict[str, Any], tensors: dict[str, Tensor]) -> nn.Module:
    """Make the network that metadata describe and load its tensors; raises ValueError if they do not fit."""
    form = described["form"]
    if (name, form) not in _CLASSES and is_installed_name(form):
        raise UsageError(f"its network is {form}, code of your own; give --form {form}")
    network_class = _CLASSES[name, form]
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


def read_tensors(path: Path, advice: str) -> Mapping[str, Any]:
    """Read the tensors of a .pth or .safetensors by name; raise ValueError where it is neither.

    A missing file raises InputError, which ends with `advice`.
    """
    if not path.is_file():
        raise InputError(f"{path}: no such file; {advice}")
    try:
        if path.suffix == ".safetensors":
            return load_file(path)
        tensors = torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:  # whatever a broken or hostile file makes its reader raise
        raise ValueError(f"cannot be read as tensors ({type(error).__name__})") from None
    if not isinstance(tensors, Mapping):
        raise ValueError("it holds no tensors by name")
    return tensors
