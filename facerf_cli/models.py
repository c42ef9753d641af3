"""The face model and the trained networks that the pipeline needs, loaded from a checkpoint."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import nn

from facerf_cli.errors import InputError
from facerf_cli.face.morphable import BUILTIN, MorphableModel, load_face_model
from facerf_cli.face.topology import LAYOUT_VERSION
from facerf_cli.network.checkpoint import load_networks
from facerf_cli.network.diffuse_sh import DiffuseNetwork
from facerf_cli.network.inputs import SourceColours
from facerf_cli.network.reflectance import ReflectanceNetwork

DEFAULT_CHECKPOINT = Path(__file__).parent / "assets" / "default.safetensors"


@dataclass(frozen=True)
class Models:
    """The face model, on the CPU as all geometry is, and the trained networks on `device`.

    A network is None where the checkpoint does not hold it.
    """

    face: MorphableModel
    network: ReflectanceNetwork | None
    geometry: nn.Module | None  # the Geometry Network, where a fit starts
    diffuse: DiffuseNetwork | None  # the network of the baseline diffuse-sh
    checkpoint_name: str
    metadata: dict[str, Any]
    device: torch.device
    source_colours: SourceColours | None = None  # of the network's training; None: no cast is removed


def load_models(checkpoint: Path | None, face_model: str | Path, device: torch.device) -> Models:
    """Load a checkpoint (None: the shipped one) and a face model (its name or file).

    Raises InputError where the checkpoint holds no network that relights, or fits another face model.
    """
    path = checkpoint or DEFAULT_CHECKPOINT
    networks, metadata = load_networks(path, LAYOUT_VERSION)
    if not networks.keys() & {"reflectance", "diffuse_sh"}:
        raise InputError(f"{path}: holds no Reflectance Network; give a checkpoint of `facerf train`")
    _require_builtin_coefficients(path, networks.get("geometry"))
    on_device: Any = {name: network.to(device).eval() for name, network in networks.items()}
    return Models(
        face=load_face_model(face_model),
        network=on_device.get("reflectance"),
        geometry=on_device.get("geometry"),
        diffuse=on_device.get("diffuse_sh"),
        checkpoint_name=path.stem,
        metadata=metadata,
        device=device,
        source_colours=_source_colours(path, metadata),
    )


def _source_colours(path: Path, metadata: dict[str, Any]) -> SourceColours | None:
    if "source_colours" not in metadata:
        return None
    try:
        return SourceColours.from_metadata(metadata["source_colours"])
    except (LookupError, TypeError, ValueError):
        raise InputError(f"{path}: invalid source_colours in its metadata; train it again") from None


def _require_builtin_coefficients(path: Path, geometry: Any) -> None:
    """Raise InputError where a Geometry Network regresses more coefficients than the built-in model has."""
    if geometry is None:
        return
    model, settings = load_face_model(BUILTIN), geometry.settings
    if settings.identity > len(model.identity) or settings.expression > len(model.expression):
        raise InputError(f"{path}: its Geometry Network fits another built-in face model; train it again")
