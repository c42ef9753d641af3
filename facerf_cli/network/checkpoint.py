"""Checkpoints: safetensors files of networks, with configuration, provenance and metrics as JSON metadata.

Tensors are named `<network>.<tensor>`. The metadata contains the form and the settings of each network.
Pickles are not loaded.
"""

import json
import pkgutil
import sys
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
from facerf_cli.network.parsing import ParsingNetwork
from facerf_cli.network.portrait import PortraitNetwork
from facerf_cli.network.reflectance import ReflectanceNetwork
from facerf_cli.network.reflectance_default import DefaultReflectanceNetwork
from facerf_cli.network.reflectance_paper import PaperReflectanceNetwork
from facerf_cli.run import memory

_FILLS = (Tensor.uniform_, Tensor.normal_)
_COPIES = 3  # of a file in memory: its tensors, its half floats in single precision, and the networks

REFLECTANCE_FORMS: dict[str, type[ReflectanceNetwork]] = {
    "default": DefaultReflectanceNetwork,
    "paper": PaperReflectanceNetwork,
}
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


def installed_class(name: str, option: str, base: type[Any]) -> type[Any]:
    """Import the subclass package.module:Class of `base`, never from the working directory.

    Raises UsageError, which names the option, if no installed package contains it.
    """
    path = sys.path[:]
    sys.path[:] = [folder for folder in path if Path(folder).resolve() != Path.cwd()]
    try:
        kind = pkgutil.resolve_name(name)
    except ImportError as error:
        advice = "install its package (the working directory is not searched)"
        raise UsageError(f"{option} {name}: {error}; {advice}") from None
    except (AttributeError, ValueError) as error:
        raise UsageError(f"{option} {name}: {error}; correct the name") from None
    finally:
        sys.path[:] = path
    if not (isinstance(kind, type) and issubclass(kind, base)):
        needed = f"{base.__module__}:{base.__name__}"
        raise UsageError(f"{option} {name}: not a subclass of {needed}; use one")
    return kind


def use_form(form: str) -> None:
    """Accept checkpoints with Reflectance Networks of the user's installed class package.module:Class.

    Names of facerf's own forms have no effect. Raises UsageError if the class does not exist.
    """
    if form in REFLECTANCE_FORMS:
        return
    if ":" not in form:
        forms = ", ".join(REFLECTANCE_FORMS)
        raise UsageError(f"--form {form}: no such form; use one of package.module:Class, {forms}")
    _CLASSES["reflectance", form] = kind = installed_class(form, "--form", ReflectanceNetwork)
    kind.form = form


def form_of(name: str, form: str) -> str:
    """Return facerf's form that a user's class extends, with its settings; else the form itself."""
    own = _CLASSES.get((name, form))
    if own is None or ":" not in form:
        return form
    for known, kind in REFLECTANCE_FORMS.items():
        if issubclass(own, kind) and issubclass(own.kind_of_settings, kind.kind_of_settings):
            return known
    return form


def new_network(name: str, form: str, settings: Mapping[str, Any]) -> Any:
    """Make an untrained network of a form; missing settings have their defaults.

    Raises UsageError for an unknown form, TypeError or ValueError for invalid settings.
    """
    forms = [known for network, known in _CLASSES if network == name]
    if form not in forms:
        raise UsageError(f"form {form}: no such {title_of(name)}; use one of {', '.join(forms)}")
    return _CLASSES[name, form].from_metadata({"form": form, **settings})


def save_networks(path: Path, networks: Mapping[str, Any], metadata: dict[str, Any]) -> None:
    """Write networks by name, with their form and settings and other metadata.

    Raises UsageError for a user's class that `use_form` has not registered.
    """
    tensors: dict[str, Tensor] = {}
    described: dict[str, Any] = {}
    for name, network in networks.items():
        if type(network) not in _CLASSES.values():
            raise UsageError(f"{type(network).__name__}: unknown network; call use_form with its name")
        tensors |= {f"{name}.{key}": tensor for key, tensor in network.state_dict().items()}
        described[name] = network.as_metadata()
    save_checkpoint(path, tensors, {"networks": described, **metadata}, half=False)


def load_networks(
    path: Path, layout_version: int, names: Collection[str] | None = None
) -> tuple[dict[str, nn.Module], dict[str, Any]]:
    """Read the networks of a checkpoint, or only the `names`, on the CPU, and its metadata.

    Raises InputError unless it is a checkpoint of this UV layout and of this version's networks, or of a form
    registered by `use_form`. No code that a file names is imported.
    """
    tensors, metadata = load_checkpoint(path)
    if metadata.get("layout_version") != layout_version:
        raise InputError(f"{path}: trained for another UV layout; train it again with this version of facerf")
    try:
        networks = {
            name: _restore(name, described, tensors)
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
    """Write tensors (with `half`, floats in half precision) and metadata atomically."""
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
            raise ValueError("some values are not finite")
    except (SafetensorError, OSError, ValueError, RuntimeError) as error:
        raise InputError(
            f"{path}: not a facerf checkpoint ({error}); use a file that `facerf train` wrote"
        ) from None
    return tensors, metadata


def _restore(name: str, described: dict[str, Any], tensors: dict[str, Tensor]) -> nn.Module:
    """Make the network described by metadata and load its tensors; raises RuntimeError if they do not fit."""
    form = described["form"]
    if (name, form) not in _CLASSES and ":" in form:
        raise UsageError(f"its network is the custom class {form}; use --form {form}")
    with _WithoutInitialValues():
        network: nn.Module = _CLASSES[name, form].from_metadata(described)
    prefix = f"{name}."
    own = {key.removeprefix(prefix): tensor for key, tensor in tensors.items() if key.startswith(prefix)}
    network.load_state_dict(own)
    # processors convolve faster in this format, and GPUs equally fast
    return network.to(memory_format=torch.channels_last)  # type: ignore[call-overload]


class _WithoutInitialValues(TorchFunctionMode):
    """Skip the random initial weights, which take seconds and which a checkpoint replaces."""

    def __torch_function__(
        self, function: Any, types: Any, args: tuple[Any, ...] = (), kwargs: dict[str, Any] | None = None
    ) -> Any:
        """Call a function of torch, unless it fills a tensor."""
        kwargs = kwargs or {}
        if function in _FILLS or getattr(function, "__module__", "") == nn.init.__name__:
            return args[0] if args else kwargs["tensor"]
        return function(*args, **kwargs)


def read_tensors(path: Path, advice: str) -> Mapping[str, Any]:
    """Read the tensors of a .pth or .safetensors by name.

    Raises InputError with `advice` if the file is missing, ValueError for another format.
    """
    if not path.is_file():
        raise InputError(f"{path}: no such file; {advice}")
    try:
        if path.suffix == ".safetensors":
            return load_file(path)
        tensors = torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:  # a broken or hostile file may raise any exception
        raise ValueError(f"cannot be read as tensors ({type(error).__name__})") from None
    if not isinstance(tensors, Mapping):
        raise ValueError("it contains no tensors by name")
    return tensors
