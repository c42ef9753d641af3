"""The interface between a training stage and the loop in `training/loop.py`."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from typing import Any, Protocol, Self, TypeVar

import numpy as np
import torch
from torch import Tensor, nn

from facerf_cli.network.inputs import SourceColours
from facerf_cli.network.precision import mixed_precision

# Entries of a checkpoint's metadata that say what its networks expect at test time (`models.py`).
INPUTS = ("source_colours", "geometry", "texture_side", "crop_px")


@dataclass(frozen=True)
class Validation:
    """Quality of the networks on held-out people."""

    metrics: dict[str, float]
    sheet: np.ndarray | None  # contact sheet [H, W, 3], scene-linear


class Batch(Protocol):
    """Samples of one step, on the CPU until moved."""

    def to(self, device: torch.device) -> Self:
        """Copy the batch to `device`."""


class Objective(nn.Module):
    """A training stage: its batches, its loss terms and its validation.

    Subclasses set the first three attributes after `super().__init__()` and implement `draw`, `forward` and
    `validate`.
    """

    networks: nn.ModuleDict  # trained, averaged, saved: by the names of network.saved.FORMS
    chooses_by: str  # metric of `validate` (lower is better) that selects best.safetensors
    provenance: dict[str, Any]  # for the checkpoint; 'licence' is that of the whole
    inputs: dict[str, Any]  # entries of `INPUTS`
    source_colours: SourceColours | None = None  # of a trained Reflectance Network's sources
    skips_networks: bool = False  # True if a batch may leave some weights without a gradient
    bf16: bool = False  # set by the loop, for `mixed_precision`

    def __init__(self) -> None:
        super().__init__()
        self.inputs = {}

    def draw(self, count: int, generator_of: Callable[[int], torch.Generator], step: int) -> Batch:
        """Draw `count` samples, sample i from `generator_of(i)` alone, independent of the others.

        A choice for the whole batch is drawn from `seeded(seed, step)`. Runs in data-loading workers, on the
        CPU and without the networks.
        """
        raise NotImplementedError

    def forward(self, batch: Any) -> dict[str, Tensor]:
        """Compute the weighted terms of the loss, each a mean over samples; the loop minimises their sum."""
        raise NotImplementedError

    def validate(self) -> Validation:
        """Measure the networks on held-out people, on the same samples every time."""
        raise NotImplementedError

    def mixed_precision(self) -> torch.autocast:
        """Context for the networks in `forward`; geometry and losses need single precision."""
        device = next(self.networks.parameters()).device
        return mixed_precision(device, self.bf16)


def seeded(*numbers: int) -> torch.Generator:
    """Make a CPU generator from non-negative numbers; their order and count matter, too."""
    state = int(np.random.SeedSequence((len(numbers), *numbers)).generate_state(1, np.uint64)[0])
    return torch.Generator().manual_seed(state >> 1)


def metrics_by_pose(errors: Tensor, same_pose: Tensor) -> dict[str, float]:
    """Mean Si-MSE of errors [N]: of all, and by whether the target has the source's pose [N]."""
    parts = {"": torch.ones_like(same_pose), "_same_pose": same_pose, "_other_pose": ~same_pose}
    return {f"si_mse{name}": float(errors[part].mean()) for name, part in parts.items() if part.any()}


Samples = TypeVar("Samples")


def concatenate(samples: Sequence[Samples]) -> Samples:
    """Join samples into a batch; they are dataclasses whose fields are all tensors [B, ...]."""
    first: Any = samples[0]
    joined: Samples = type(first)(
        *(torch.cat([getattr(sample, field.name) for sample in samples]) for field in fields(first))
    )
    return joined
