"""Face model and trained networks, loaded on first use onto their device."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

import torch
from torch import nn

from facerf_cli.errors import InputError, UsageError
from facerf_cli.face.fit import Geometry
from facerf_cli.face.morphable import BUILTIN, MorphableModel, load_face_model
from facerf_cli.face.topology import LAYOUT_VERSION
from facerf_cli.files.texts import file_sha256
from facerf_cli.network.checkpoint import load_networks, use_form
from facerf_cli.network.diffuse_sh import DiffuseNetwork
from facerf_cli.network.features import LightNetwork
from facerf_cli.network.files import SHIPPED, checkpoint_file, read_metadata, serving_files
from facerf_cli.network.inputs import SourceColours
from facerf_cli.network.parsing import ParsingNetwork
from facerf_cli.network.portrait import PortraitNetwork
from facerf_cli.network.reflectance import ReflectanceNetwork
from facerf_cli.network.stored_graph import ASSET, PeopleNetworks, mediapipe_networks
from facerf_cli.portrait.parse import CLASSES, LANDMARKS

TEXTURE_SIDE, LARGEST_TEXTURE = 256, 2048  # texels: default and maximum
CROP_PER_TEXTURE = 2  # crop side over texture side, so that unwrapping averages pixels
_CPU = torch.device("cpu")


@dataclass(frozen=True)
class Sides:
    """Side of the face texture in texels, and of the crop that it is unwrapped from."""

    texture: int
    crop_px: int


class Networks:
    """Trained networks by name. Each is loaded on first access and kept on the device.

    `custom` networks replace those in files. Accessing a network raises InputError if its file is damaged or
    from another version.
    """

    reflectance: ReflectanceNetwork
    geometry: nn.Module
    diffuse_sh: DiffuseNetwork
    light_features: LightNetwork  # S_f
    parsing: ParsingNetwork
    portrait: PortraitNetwork
    people: PeopleNetworks  # find people and segment them

    def __init__(
        self,
        files: Mapping[str, Path] = SHIPPED,
        device: torch.device = _CPU,
        custom: Mapping[str, nn.Module] | None = None,
    ) -> None:
        self.files, self.device, self._custom = dict(files), device, dict(custom or {})
        vars(self).update(self._custom)

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle only the files, which another process loads once; networks without a file as they are."""
        if self._custom:
            return Networks, (self.files, self.device, self._custom)
        return _networks_once, (tuple(self.files.items()), self.device)

    def __getattr__(self, name: str) -> Any:
        if name == "people":
            self.people = PeopleNetworks(self.parsing, *mediapipe_networks(self.device))
        elif name in SHIPPED:
            network: Any = load_networks(self.files[name], LAYOUT_VERSION, (name,))[0][name]
            _check(self.files[name], name, network)
            setattr(self, name, network.to(self.device).eval().requires_grad_(False))
        else:
            raise AttributeError(name)
        return vars(self)[name]

    def load(self, names: Iterable[str]) -> None:
        for name in names:
            getattr(self, name)

    def with_networks(self, **networks: nn.Module) -> "Networks":
        """Return a copy with some networks replaced."""
        loaded = {name: network for name, network in vars(self).items() if name in SHIPPED}
        return Networks(self.files, self.device, {**loaded, **networks})

    def sha256(self, name: str) -> str:
        return described_file(self.files[name])["sha256"]

    def served(self) -> dict[str, dict[str, str]]:
        """Return file and SHA-256 of each network that was loaded so far, for reports."""
        files = {name: self.files[name] for name in SHIPPED if name in vars(self)}
        if "people" in vars(self):
            files["mediapipe"] = ASSET
        return {name: described_file(path) for name, path in files.items()}


def _check(path: Path, name: str, network: Any) -> None:
    if name == "parsing" and (network.settings.classes, network.settings.landmarks) != (
        len(CLASSES),
        LANDMARKS,
    ):
        raise InputError(f"{path}: not a Parsing Network of this version; train one with --stage parsing")
    if name == "geometry":
        model, settings = load_face_model(BUILTIN), network.settings
        if settings.identity > len(model.identity) or settings.expression > len(model.expression):
            raise InputError(f"{path}: its Geometry Network fits another built-in face model; train it again")


@cache  # networks are loaded once per process
def _networks_once(files: tuple[tuple[str, Path], ...], device: torch.device) -> Networks:
    return Networks(dict(files), device)


SHIPPED_NETWORKS = Networks()  # on the CPU; the networks of a command are in its Models


@dataclass(frozen=True)
class Models:
    """Face model, on the CPU like all geometry, and trained networks on their device."""

    face: MorphableModel
    networks: Networks
    trained_sides: Sides = Sides(TEXTURE_SIDE, CROP_PER_TEXTURE * TEXTURE_SIDE)
    default_geometry: Geometry = "landmarks"  # "network" if both networks were trained together
    source_colours: SourceColours | None = None  # of the training data; None: colour casts are not removed

    @property
    def device(self) -> torch.device:
        return self.networks.device

    def checkpoint_name(self, network: str = "reflectance") -> str:
        """Return the name of a network's file without suffix."""
        return self.networks.files[network].stem

    def with_networks(self, **networks: nn.Module) -> "Models":
        """Return a copy with some networks replaced."""
        return replace(self, networks=self.networks.with_networks(**networks))

    def sides(self, texture_side: int | None = None) -> Sides:
        """Return the sides used in training, or a custom texture side with a crop in the same proportion."""
        trained = self.trained_sides
        if texture_side is None:
            return trained
        return Sides(texture_side, round(texture_side * trained.crop_px / trained.texture))


def load_models(
    checkpoint: str | Path | Sequence[str | Path] | None = None,
    face_model: str | Path = BUILTIN,
    device: str | torch.device = "cpu",
    form: str | Sequence[str] | None = None,
) -> Models:
    """Load a face model and networks. A network is read from its file when it is first used.

    Args:
        checkpoint: A checkpoint or the folder of a training run, or a list of them. Each provides the
            networks that its last training trained; all others are the shipped ones.
        face_model: "builtin", or the file of an imported face model.
        device: "cpu", "cuda", "cuda:1", "mps" or a `torch.device`.
        form: "package.module:Class", the name of an installed custom Reflectance Network, or a list.

    Raises:
        InputError: A file is not a checkpoint.
        UsageError: torch does not find the device.
    """
    if isinstance(device, str):
        try:
            device = torch.empty(0, device=device).device
        except (RuntimeError, AssertionError):
            raise UsageError(f"device {device}: not found by torch; use cpu, cuda or mps") from None
    for name in [form] if isinstance(form, str) else form or ():
        use_form(name)
    checkpoints = [checkpoint] if isinstance(checkpoint, (str, Path)) else checkpoint or ()
    files = serving_files([checkpoint_file(Path(path)) for path in checkpoints], user="facerf")
    path = files["reflectance"]
    metadata = read_metadata(path)
    side = _side(path, metadata, "texture_side", TEXTURE_SIDE)
    return Models(
        face=load_face_model(face_model),
        networks=Networks(files, device),
        trained_sides=Sides(side, _side(path, metadata, "crop_px", CROP_PER_TEXTURE * side)),
        default_geometry="network" if metadata.get("geometry") == "network" else "landmarks",
        source_colours=_source_colours(path, metadata),
    )


def _side(path: Path, metadata: dict[str, Any], name: str, default: int) -> int:
    side = metadata.get(name, default)
    if type(side) is not int or not 16 <= side <= CROP_PER_TEXTURE * LARGEST_TEXTURE:
        raise InputError(f"{path}: invalid {name} in its metadata; train it again")
    return side


def _source_colours(path: Path, metadata: dict[str, Any]) -> SourceColours | None:
    if "source_colours" not in metadata:
        return None
    try:
        return SourceColours.from_metadata(metadata["source_colours"])
    except (LookupError, TypeError, ValueError):
        raise InputError(f"{path}: invalid source_colours in its metadata; train it again") from None


@cache  # hashing a checkpoint takes longer than rendering an image
def described_file(path: Path) -> dict[str, str]:
    """Return path and SHA-256 of a checkpoint, for reports; for a shipped one only its name."""
    return {
        "file": path.name if path in (*SHIPPED.values(), ASSET) else str(path),
        "sha256": file_sha256(path),
    }
