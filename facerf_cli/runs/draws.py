"""Batches of an objective, drawn ahead by worker processes; each depends on (seed, step, index) alone."""

import copy
import time
from collections.abc import Iterator
from dataclasses import dataclass

import torch
from torch.utils.data import DataLoader, Dataset

from facerf_cli.errors import FacerfError
from facerf_cli.objectives.objective import Batch, Objective, seeded

_ENDLESS = 1 << 31


@dataclass(frozen=True)
class Drawn:
    """The batch of a step, and how long the loop waited for it."""

    step: int
    batch: Batch
    waited_s: float


def drawn_batches(
    objective: Objective, first_step: int, count: int, first_index: int, seed: int, workers: int
) -> Iterator[Drawn]:
    """Samples `first_index` to `first_index + count` of the batch of every step from `first_step` on."""
    steps = range(first_step, _ENDLESS)
    loader = DataLoader(
        _Draws(objective, count, first_index, seed),
        batch_size=None,
        sampler=steps,
        num_workers=workers,
        generator=torch.Generator(),  # not the global one: a resumed run would draw otherwise
    )
    batches = iter(loader)
    for step in steps:
        begin = time.monotonic()
        batch = next(batches)
        if isinstance(batch, FacerfError):
            raise batch
        yield Drawn(step, batch, time.monotonic() - begin)


class _Draws(Dataset[Batch | FacerfError]):
    def __init__(self, objective: Objective, count: int, first_index: int, seed: int) -> None:
        self.objective = copy.copy(objective)
        self.objective.__dict__ |= {
            "_modules": {},
            "_buffers": {},
        }  # drawing needs neither: none go to workers
        self.count, self.first_index, self.seed = count, first_index, seed

    def __getitem__(self, step: int) -> Batch | FacerfError:
        def generator_of(index: int) -> torch.Generator:
            return seeded(self.seed, step, self.first_index + index)

        try:
            return self.objective.draw(self.count, generator_of, step)
        except FacerfError as error:  # its one line, where the loader would give a traceback
            return error
