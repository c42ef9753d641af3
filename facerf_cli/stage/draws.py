"""Random numbers between bounds, by a generator of one's own."""

from dataclasses import dataclass

import torch
from torch import Tensor


@dataclass(frozen=True, eq=False)
class Uniform:
    """Draws even numbers of a shape, that of `shape` where a call names none."""

    generator: torch.Generator
    shape: tuple[int, ...] = ()

    def __call__(self, low: float, high: float, *shape: int) -> Tensor:
        """Numbers from `low` to `high`."""
        return low + (high - low) * torch.rand(shape or self.shape, generator=self.generator)
