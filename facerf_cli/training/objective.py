"""What a stage of training minimises, as the loop in `training/loop.py` sees it."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from typing import Any, Protocol, Self, TypeVar

import numpy as np
import torch
from torch import Tensor, nn


@dataclass(frozen=True)
class Validation:
    """What networks are worth on held-out people."""

    metrics: dict[str, float]
    sheet: np.ndarray | None  # contact sheet [H, W, 3], scene-linear


class Batch(Protocol):
    """What one step learns from; tensors on the CPU until it is moved."""

    def to(self, device: torch.device) -> Self:
        """The same batch on `device`."""


class Objective(nn.Module):
    """Draws batches, weighs their losses, and measures what was learnt.

    The loop knows no more of a stage than this. Subclasses set the three attributes after
    `super().__init__()` and implement `draw`, `forward` and `validate`.
    """

    networks: nn.ModuleDict  # trained, averaged, saved: by the names of network.saved.FORMS
    chooses_by: str  # the metric of `validate`, lower is better, that chooses best.safetensors
    provenance: dict[str, Any]  # for the checkpoint; its 'licence' is the words for the whole
    skips_networks: bool = False  # whether a batch may leave some of their weights without a gradient
    bf16: bool = False  # set by the loop: networks may run in mixed precision, see `mixed_precision`

    def draw(self, count: int, generator_of: Callable[[int], torch.Generator], step: int) -> Batch:
        """`count` samples, sample i with `generator_of(i)` alone, so that it never depends on its neighbours.

        A kind that holds for a whole batch is drawn with `seeded(seed, step)`. Runs in data-loading workers:
        tensors of the CPU, and the networks are not touched.
        """
        raise NotImplementedError

    def forward(self, batch: Any) -> dict[str, Tensor]:
        """Weighted terms of the loss, each a mean over the batch's samples; their sum is minimised."""
        raise NotImplementedError

    def validate(self) -> Validation:
        """Measure the networks as they are on held-out people, on the same samples every time."""
        raise NotImplementedError

    def mixed_precision(self) -> torch.autocast:
        """For the networks' share of `forward` alone: geometry and losses want single precision."""
        device = next(self.networks.parameters()).device
        return torch.autocast(device.type, torch.bfloat16, enabled=self.bf16)


def seeded(*numbers: int) -> torch.Generator:
    """A generator of the CPU that depends on all of these non-negative numbers, their order and count."""
    state = int(np.random.SeedSequence((len(numbers), *numbers)).generate_state(1, np.uint64)[0])
    return torch.Generator().manual_seed(state >> 1)


Samples = TypeVar("Samples")


def concatenate(samples: Sequence[Samples]) -> Samples:
    """One batch of samples: dataclasses whose fields are all tensors [B, ...]."""
    first: Any = samples[0]
    joined: Samples = type(first)(
        *(torch.cat([getattr(sample, field.name) for sample in samples]) for field in fields(first))
    )
    return joined
