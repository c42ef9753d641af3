"""Base of the training stages: batches, loss terms, validation and its contact sheets, scene-linear.

`training/loop.py` takes the steps.
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from facerf_cli.network.base import mixed_precision
from facerf_cli.network.batch import Batch, concatenate
from facerf_cli.network.inputs import SourceColours

# Entries of a checkpoint's metadata that say what its networks expect at test time (`models.py`).
INPUTS = ("source_colours", "geometry", "texture_side", "crop_px")
TRUE_COLOUR, FOUND_COLOUR = (0.0, 1.0, 0.0), (1.0, 0.0, 0.0)  # of landmarks on sheets


@dataclass(frozen=True)
class Validation:
    """Quality of the networks on held-out people."""

    metrics: dict[str, float]
    sheet: np.ndarray | None  # contact sheet [H, W, 3], scene-linear


class Objective(nn.Module):
    """Base of the training stages: batches, loss terms and validation.

    Subclasses implement `draw`, `forward` and `validate`.
    """

    chooses_by: str  # metric of `validate` (lower is better) that selects best.safetensors
    source_colours: SourceColours | None = None  # of a trained Reflectance Network's sources
    skips_networks: bool = False  # True if a batch may leave some weights without a gradient
    bf16: bool = False  # set by the loop, for `mixed_precision`

    def __init__(self, networks: dict[str, nn.Module], provenance: dict[str, Any]) -> None:
        """Make a stage that trains, averages and saves networks, by the names of `network/checkpoint.py`.

        provenance: Origin of the data, for the checkpoint; 'licence' covers all of it.
        """
        super().__init__()
        self.networks = nn.ModuleDict(networks)
        self.provenance = provenance
        self.inputs: dict[str, Any] = {}  # entries of `INPUTS`

    def draw(self, count: int, generator_of: Callable[..., torch.Generator], step: int) -> Batch:
        """Draw `count` samples; sample i depends only on `generator_of(i)`.

        `generator_of(i, step)` belongs to another step, for samples that share data that is slow to read. A
        choice for the entire batch is drawn from `seeded(seed, step)`. Runs in data-loading workers, on the
        CPU and without the networks.
        """
        raise NotImplementedError

    def measure(self) -> None:
        """Measure constants of the losses with the networks, once all processes have them on their device."""

    def forward(self, batch: Any) -> dict[str, Tensor]:
        """Compute the weighted terms of the loss, each a mean over samples; the loop minimises their sum."""
        raise NotImplementedError

    def validate(self) -> Validation:
        """Measure the networks on held-out people, on the same samples every time."""
        raise NotImplementedError

    def mixed_precision(self) -> torch.autocast:
        """Return a context for the networks in `forward`; geometry and losses need single precision."""
        return mixed_precision(self.device, self.bf16)

    @property
    def network(self) -> Any:
        """Network of a stage that trains one."""
        (network,) = self.networks.values()
        return network

    @property
    def device(self) -> torch.device:
        return next(self.networks.parameters()).device


class PeopleObjective(Objective):
    """Base of the stages that train one network on samples of people; subclasses implement `draw_person`."""

    validation_seed: int = 12345

    def __init__(self, name: str, network: nn.Module, source: Any, settings: Any) -> None:
        """Make a stage that trains the network `name`.

        Args:
            source: People to draw samples of, such as a `SampleSource`; with `provenance` and `people`.
            settings: Settings with `held_out_people`, the number of people who are only validated on, and
                `held_out_draws`, the number of samples of each of them.
        """
        super().__init__({name: network}, source.provenance)
        self.source, self.settings = source, settings
        self.people, self.held_out = source.people(settings.held_out_people)
        self._held_out_samples: list[Any] = []

    def draw(self, count: int, generator_of: Callable[..., torch.Generator], step: int) -> Any:
        return concatenate([self.draw_one(generator_of(i)) for i in range(count)])

    def draw_one(self, generator: torch.Generator) -> Any:
        """Draw one sample of a random person, B = 1."""
        return self.draw_person(self.any_person(generator), generator)

    def any_person(self, generator: torch.Generator) -> int:
        """Draw a person to train on."""
        return int(self.people[int(torch.randint(len(self.people), (), generator=generator))])

    def draw_person(self, person: int, generator: torch.Generator) -> Any:
        """Draw one sample of a person, B = 1."""
        raise NotImplementedError

    def draw_held_out(self, person: int, generator: torch.Generator) -> Any:
        """Draw one sample of a held-out person, B = 1."""
        return self.draw_person(person, generator)

    def held_out_samples(self) -> list[Any]:
        """Return samples of the held-out people, B = 1, drawn once."""
        if not self._held_out_samples:
            self._held_out_samples = [
                self.draw_held_out(int(person), seeded(self.validation_seed, int(person), index))
                for index in range(self.settings.held_out_draws)
                for person in self.held_out
            ]
        return self._held_out_samples


def seeded(*numbers: int) -> torch.Generator:
    """Make a CPU generator from non-negative numbers; their order and count also matter."""
    state = int(np.random.SeedSequence((len(numbers), *numbers)).generate_state(1, np.uint64)[0])
    return torch.Generator().manual_seed(state >> 1)


def tiled(rows: Iterable[Iterable[Tensor]]) -> np.ndarray:
    """Join rows of images [3, h, w] into a contact sheet [H, W, 3]."""
    sheet: np.ndarray = torch.cat([torch.cat([*row], -1) for row in rows], -2).permute(1, 2, 0).cpu().numpy()
    return sheet


def in_rows(cells: Sequence[Tensor], columns: int) -> list[Sequence[Tensor]]:
    """Split images into rows of `columns`; a shorter last row is dropped."""
    rows = [cells[first : first + columns] for first in range(0, len(cells), columns)]
    return [row for row in rows if len(row) == len(rows[0])]


def mark(image: Tensor, points_px: Tensor, colour: tuple[float, float, float]) -> None:
    """Draw dots of 2 x 2 pixels at points [N, 2] of an image [3, S, S], in place."""
    for x, y in points_px.long().clamp(0, image.shape[-1] - 2).tolist():
        image[:, y : y + 2, x : x + 2] = torch.tensor(colour).view(3, 1, 1)
