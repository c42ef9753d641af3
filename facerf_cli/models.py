"""The face model and the trained networks that the pipeline needs, loaded from a checkpoint."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import nn

from facerf_cli.errors import InputError
from facerf_cli.face.fit import Geometry
from facerf_cli.face.morphable import BUILTIN, MorphableModel, load_face_model
from facerf_cli.face.topology import LAYOUT_VERSION
from facerf_cli.network.checkpoint import load_networks
from facerf_cli.network.diffuse_sh import DiffuseNetwork
from facerf_cli.network.inputs import SourceColours
from facerf_cli.network.reflectance import ReflectanceNetwork

TEXTURE_SIDE, LARGEST_TEXTURE = 256, 2048  # texels: by default, and at most
CROP_PER_TEXTURE = 2  # side of the crop over that of the texture, so that unwrapping averages pixels
NO_GEOMETRY_NETWORK = (
    "a checkpoint without a Geometry Network, which --geometry network needs; give --geometry landmarks, or "
    "another --checkpoint"
)
DEFAULT_CHECKPOINT = Path(__file__).parent / "assets" / "default.safetensors"


@dataclass(frozen=True)
class Sides:
    """Sides of a texture and of the crop that it is unwrapped from."""

    texture: int
    crop_px: int


@dataclass(frozen=True)
class Models:
    """The face model, on the CPU as all geometry is, and the trained networks on `device`.

    A network is None where the checkpoint does not hold it.
    """

    face: MorphableModel
    network: ReflectanceNetwork | None
    geometry: nn.Module | None  # the Geometry Network
    diffuse: DiffuseNetwork | None  # the network of the baseline diffuse-sh
    checkpoint_name: str
    metadata: dict[str, Any]
    device: torch.device
    trained_sides: Sides = Sides(TEXTURE_SIDE, CROP_PER_TEXTURE * TEXTURE_SIDE)  # or the default ones
    default_geometry: Geometry = "landmarks"  # "network" if both networks were trained together
    source_colours: SourceColours | None = None  # of the network's training; None: no cast is removed

    def sides(self, texture_side: int | None = None) -> Sides:
        """The sides that the networks were trained on; or a texture's, with a crop in the same proportion."""
        trained = self.trained_sides
        if texture_side is None:
            return trained
        return Sides(texture_side, round(texture_side * trained.crop_px / trained.texture))


def load_models(checkpoint: Path | None, face_model: str | Path, device: torch.device) -> Models:
    """Load a checkpoint (None: the shipped one) and a face model (its name or file).

    Raises InputError where the checkpoint holds no network that relights, or fits another face model.
    """
    path = checkpoint or DEFAULT_CHECKPOINT
    networks, metadata = load_networks(path, LAYOUT_VERSION)
    if not networks.keys() & {"reflectance", "diffuse_sh"}:
        raise InputError(f"{path}: holds no Reflectance Network; give a checkpoint of `facerf train`")
    _require_builtin_coefficients(path, networks.get("geometry"))
    side = _side(path, metadata, "texture_side", TEXTURE_SIDE)
    on_device: Any = {name: network.to(device).eval() for name, network in networks.items()}
    return Models(
        face=load_face_model(face_model),
        network=on_device.get("reflectance"),
        geometry=on_device.get("geometry"),
        diffuse=on_device.get("diffuse_sh"),
        checkpoint_name=path.stem,
        metadata=metadata,
        device=device,
        trained_sides=Sides(side, _side(path, metadata, "crop_px", CROP_PER_TEXTURE * side)),
        default_geometry=default_geometry(metadata),
        source_colours=_source_colours(path, metadata),
    )


def _side(path: Path, metadata: dict[str, Any], name: str, default: int) -> int:
    side = metadata.get(name, default)
    if type(side) is not int or not 16 <= side <= CROP_PER_TEXTURE * LARGEST_TEXTURE:
        raise InputError(f"{path}: invalid {name} in its metadata; train it again")
    return side


def default_geometry(metadata: dict[str, Any]) -> Geometry:
    """Geometry of a checkpoint's training, by default that of photos, too."""
    return "network" if metadata.get("geometry") == "network" else "landmarks"


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
