"""Batches of tensors: moved, split and joined as one."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from typing import Self, TypeVar

import torch
from torch import Tensor


@dataclass(frozen=True)
class Batch:
    """Base of dataclasses whose fields are tensors [B, ...] or other batches."""

    def each(self, function: Callable[[Tensor], Tensor]) -> Self:
        """Apply a function to every tensor."""
        values = (getattr(self, field.name) for field in fields(self))
        return type(self)(*(x.each(function) if isinstance(x, Batch) else function(x) for x in values))

    def to(self, device: torch.device) -> Self:
        """Copy all tensors to `device`; from pinned memory, a GPU copies them asynchronously."""
        return self.each(lambda values: values.to(device, non_blocking=device.type == "cuda"))

    def pin_memory(self) -> Self:
        """Return a copy in pinned memory; the data loader calls this."""
        return self.each(torch.Tensor.pin_memory)

    def parts(self, count: int) -> list[Self]:
        """Split the samples into `count` batches of the same size."""
        return [self.each(lambda values: values.chunk(count)[part]) for part in range(count)]  # noqa: B023


Samples = TypeVar("Samples", bound=Batch)


def concatenate(samples: Sequence[Samples]) -> Samples:
    """Join samples into a batch."""
    parts = [[getattr(sample, field.name) for sample in samples] for field in fields(samples[0])]
    return type(samples[0])(*(concatenate(x) if isinstance(x[0], Batch) else torch.cat(x) for x in parts))
