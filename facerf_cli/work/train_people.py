"""The stages of training that look at whole synthetic people: their banks, and their objectives."""

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from torch import Tensor

from facerf_cli.face.morphable import load_face_model
from facerf_cli.network.parsing import ParsingNetwork, ParsingSettings
from facerf_cli.network.portrait import PortraitNetwork, PortraitSettings
from facerf_cli.synth.bank.parsing import StoredPortraits
from facerf_cli.synth.bank.portrait_samples import PortraitSource, StoredTransport
from facerf_cli.synth.bank.portraits import PortraitBankSettings, add_portraits, load_backgrounds
from facerf_cli.synth.bank.transport import TransportBankSettings, add_proxies, add_transport
from facerf_cli.synth.head.mesh import MAKEHUMAN_LICENCE
from facerf_cli.training.parsing_objective import ParsingObjective, ParsingObjectiveSettings
from facerf_cli.training.portrait_objective import PortraitObjective, PortraitObjectiveSettings

_MAPS, _HEAPS = 60, 240  # backgrounds: surroundings, each seen from several sides, and heaps of shapes
_TINY_WIDTHS, _TINY_BLOCKS = (8, 8, 12, 16), (0, 1, 1, 1)


@dataclass(frozen=True, eq=False)
class WholePeople:
    """Synthetic people by number, the face models they take turns in, and what else the banks need."""

    indices: range
    held_out: int
    models: list[str]
    backgrounds_path: Path
    seed: int
    jobs: int
    tiny: bool

    @cached_property
    def backgrounds(self) -> Tensor:
        """Backgrounds of their photos."""
        return drawn_backgrounds(self.backgrounds_path, self.seed, self.tiny)

    def provenance(self) -> dict[str, Any]:
        """Origin and licence of the people."""
        drawn = [load_face_model(model) for model in self.models]
        shapes = [f"the heads' shapes: {model.licence}" for model in drawn]
        return {
            "heads": f"synthetic people drawn from {' and '.join(model.credit for model in drawn)}",
            "licence": "; ".join(["MIT", *shapes, MAKEHUMAN_LICENCE]),
        }


def drawn_backgrounds(path: Path, seed: int, tiny: bool) -> Tensor:
    """Backgrounds of photos, drawn where their file is missing."""
    path.parent.mkdir(parents=True, exist_ok=True)
    maps, heaps = (1, 4) if tiny else (_MAPS, _HEAPS)
    return load_backgrounds(path, maps, heaps, seed)


def parsing_objective(people: WholePeople, folder: Path, network: Any) -> ParsingObjective:
    """The stage parsing; photos that are missing in `folder` are taken first."""
    provenance = people.provenance()
    settings = PortraitBankSettings(views=1, photos=1, side_px=96) if people.tiny else PortraitBankSettings()
    add_portraits(folder, people.models, people.indices, people.jobs, people.seed, settings)
    stored = StoredPortraits(folder, people.backgrounds, provenance)
    own = ParsingSettings(_TINY_WIDTHS, _TINY_BLOCKS, side=64) if people.tiny else ParsingSettings()
    objective = ParsingObjectiveSettings(held_out_people=people.held_out)
    return ParsingObjective(stored, network or ParsingNetwork(own), objective)


def stored_transport(people: WholePeople, folder: Path) -> StoredTransport:
    """Synthetic people of the stage portrait; those that are missing in `folder` are baked and seen first."""
    settings = TransportBankSettings(views=1, looks=1, lights=12) if people.tiny else TransportBankSettings()
    add_transport(folder, people.models, people.indices, people.jobs, people.seed, settings)
    add_proxies(folder, people.backgrounds, people.jobs, people.seed)
    return StoredTransport(folder, people.backgrounds, people.provenance())


def portrait_objective(source: PortraitSource, held_out: int, tiny: bool, network: Any) -> PortraitObjective:
    """The stage portrait on people of a source, of whom at most `held_out` are held out."""
    own = PortraitSettings(_TINY_WIDTHS, _TINY_BLOCKS) if tiny else PortraitSettings()
    settings = PortraitObjectiveSettings(held_out_people=held_out, targets=2 if tiny else 4)
    return PortraitObjective(source, network or PortraitNetwork(own), settings)
