"""The face model and every trained network, on its device, from the shipped file or the user's."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

import torch
from torch import nn

from facerf_cli.errors import InputError
from facerf_cli.face.fit import Geometry
from facerf_cli.face.morphable import BUILTIN, MorphableModel, load_face_model
from facerf_cli.face.topology import LAYOUT_VERSION
from facerf_cli.files.texts import file_sha256
from facerf_cli.network.checkpoint import load_networks, use_form
from facerf_cli.network.diffuse_sh import DiffuseNetwork
from facerf_cli.network.features import LightNetwork
from facerf_cli.network.files import SHIPPED, read_metadata, serving_files
from facerf_cli.network.geometry import GeometryNetwork
from facerf_cli.network.inputs import SourceColours
from facerf_cli.network.parsing import ParsingNetwork
from facerf_cli.network.portrait import PortraitNetwork
from facerf_cli.network.reflectance import ReflectanceNetwork
from facerf_cli.network.stored_graph import ASSET, PeopleNetworks, mediapipe_networks
from facerf_cli.portrait.parse import CLASSES, LANDMARKS

TEXTURE_SIDE, LARGEST_TEXTURE = 256, 2048  # texels: by default, and at most
_CPU = torch.device("cpu")
CROP_PER_TEXTURE = 2  # side of the crop over that of the texture, so that unwrapping averages pixels


@dataclass(frozen=True)
class Sides:
    """Sides of a texture and of the crop that it is unwrapped from."""

    texture: int
    crop_px: int


class Networks:
    """The trained networks by name, each loaded when it is first read, and kept on the device.

    Reading one raises InputError for a file that is damaged or of another version.

    Args:
        files: File of each network, by its name.
        device: Where they compute.
        given: Networks in place of those of files.
    """

    reflectance: ReflectanceNetwork
    geometry: nn.Module
    diffuse_sh: DiffuseNetwork
    light_features: LightNetwork  # S_f
    parsing: ParsingNetwork
    portrait: PortraitNetwork
    people: PeopleNetworks  # that find people and cut them out

    def __init__(
        self,
        files: Mapping[str, Path] = SHIPPED,
        device: torch.device = _CPU,
        given: Mapping[str, nn.Module] | None = None,
    ) -> None:
        self.files, self.device, self._given = dict(files), device, dict(given or {})
        vars(self).update(self._given)

    def __reduce__(self) -> tuple[Any, ...]:
        """Send the files to another process, which loads each network once, or the given networks."""
        if self._given:
            return Networks, (self.files, self.device, self._given)
        return _networks_once, (tuple(self.files.items()), self.device)

    def __getattr__(self, name: str) -> Any:
        """Load a network that has not been read before."""
        if name == "people":
            self.people = PeopleNetworks(self.parsing, *mediapipe_networks(self.device))
        elif name in SHIPPED:
            path = self.files[name]
            network: Any = load_networks(path, LAYOUT_VERSION, (name,))[0][name]
            if name in _CHECKS:
                _CHECKS[name](path, network)
            setattr(self, name, network.to(self.device).eval().requires_grad_(False))
        else:
            raise AttributeError(name)
        return vars(self)[name]

    def load(self, names: Iterable[str]) -> None:
        """Load networks by name."""
        for name in names:
            getattr(self, name)

    def with_networks(self, **networks: nn.Module) -> "Networks":
        """Return the same networks with others in place of some."""
        loaded = {name: network for name, network in vars(self).items() if name in SHIPPED}
        return Networks(self.files, self.device, {**loaded, **networks})

    def sha256(self, name: str) -> str:
        """SHA-256 of the file that serves a network."""
        return described_file(self.files[name])["sha256"]

    def served(self) -> dict[str, dict[str, str]]:
        """File and SHA-256 of each network that was needed so far, for reports."""
        files = {name: self.files[name] for name in SHIPPED if name in vars(self)}
        if "people" in vars(self):
            files["mediapipe"] = ASSET
        return {name: described_file(path) for name, path in files.items()}


def _check_parsing(path: Path, network: ParsingNetwork) -> None:
    """Raise InputError for a Parsing Network of other classes or landmarks."""
    if (network.settings.classes, network.settings.landmarks) != (len(CLASSES), LANDMARKS):
        raise InputError(f"{path}: holds no Parsing Network of this version; train one, --stage parsing")


def _check_geometry(path: Path, network: GeometryNetwork) -> None:
    """Raise InputError where a Geometry Network regresses more coefficients than the built-in model has."""
    model, settings = load_face_model(BUILTIN), network.settings
    if settings.identity > len(model.identity) or settings.expression > len(model.expression):
        raise InputError(f"{path}: its Geometry Network fits another built-in face model; train it again")


_CHECKS: dict[str, Callable[[Path, Any], None]] = {"parsing": _check_parsing, "geometry": _check_geometry}


@cache  # loaded once a process
def _networks_once(files: tuple[tuple[str, Path], ...], device: torch.device) -> Networks:
    return Networks(dict(files), device)


SHIPPED_NETWORKS = Networks()  # on the CPU; a verb's own are in its Models


@dataclass(frozen=True)
class Models:
    """The face model, on the CPU as all geometry is, and the trained networks on their device."""

    face: MorphableModel
    networks: Networks
    trained_sides: Sides = Sides(TEXTURE_SIDE, CROP_PER_TEXTURE * TEXTURE_SIDE)  # or the default ones
    default_geometry: Geometry = "landmarks"  # "network" if both networks were trained together
    source_colours: SourceColours | None = None  # of the network's training; None: no cast is removed

    @property
    def device(self) -> torch.device:
        """The device of the networks."""
        return self.networks.device

    def checkpoint_name(self, network: str = "reflectance") -> str:
        """Name of the file that serves a network."""
        return self.networks.files[network].stem

    def with_networks(self, **networks: nn.Module) -> "Models":
        """Return the same models with other networks in place of some."""
        return replace(self, networks=self.networks.with_networks(**networks))

    def sides(self, texture_side: int | None = None) -> Sides:
        """The sides that the networks were trained on; or a texture's, with a crop in the same proportion."""
        trained = self.trained_sides
        if texture_side is None:
            return trained
        return Sides(texture_side, round(texture_side * trained.crop_px / trained.texture))


def load_models(
    checkpoints: Sequence[Path] = (),
    face_model: str | Path = BUILTIN,
    device: torch.device = _CPU,
    form: str | None = None,
) -> Models:
    """Load a face model (its name or file); the networks of checkpoints, else the shipped ones, follow.

    A network is loaded when it is first needed. Its form may be package.module:Class of code that is
    installed. Raises InputError for what is no checkpoint.
    """
    use_form(form)
    files = serving_files(checkpoints, user="facerf")
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


@cache  # of many MB
def described_file(path: Path) -> dict[str, str]:
    """Path and SHA-256 of a checkpoint, for reports; of a shipped one the name alone."""
    return {
        "file": path.name if path in (*SHIPPED.values(), ASSET) else str(path),
        "sha256": file_sha256(path),
    }
