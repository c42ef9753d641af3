"""Batches of an objective, drawn ahead by worker processes; each depends on (seed, step, index) alone.

Training by several processes: `torchrun --nproc-per-node N -m facerf_cli train ...`.
"""

import copy
import datetime
import os
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import torch
import torch.distributed as dist
from torch import Tensor, nn
from torch.nn.parallel import DistributedDataParallel
from torch.utils.data import DataLoader, Dataset

from facerf_cli.errors import FacerfError
from facerf_cli.training.objective import Batch, Objective, seeded

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


_PATIENCE = datetime.timedelta(hours=24)  # of the others, while the first bakes heads or validates


@contextmanager
def joined_processes() -> Iterator[None]:
    """Join the group that torchrun described in the environment, if it did, and leave it at the end."""
    if int(os.environ.get("WORLD_SIZE", "1")) < 2 or dist.is_initialized():
        yield
        return
    backend = "cpu:gloo,cuda:nccl" if torch.cuda.is_available() else "gloo"
    dist.init_process_group(backend, timeout=_PATIENCE)
    try:
        yield
    finally:
        dist.destroy_process_group()


def process_count() -> int:
    """How many processes train."""
    return dist.get_world_size() if dist.is_initialized() else 1


def process_rank() -> int:
    """Which of them this is; 0 alone writes files."""
    return dist.get_rank() if dist.is_initialized() else 0


def own_device(device: torch.device) -> torch.device:
    """The GPU of this process where there are several on a machine."""
    if device.type != "cuda" or process_count() == 1:
        return device
    own = torch.device("cuda", int(os.environ.get("LOCAL_RANK", "0")))
    torch.cuda.set_device(own)
    return own


@contextmanager
def first_process_first() -> Iterator[None]:
    """Run a block in process 0, then in all others at once, which find what it made."""
    if process_rank() > 0:
        mean_of_all(torch.zeros(1))  # on the CPU, where a barrier would take a GPU
    yield
    if process_rank() == 0:
        mean_of_all(torch.zeros(1))


def shared(objective: nn.Module, skips_networks: bool) -> nn.Module:
    """The objective with gradients averaged over all processes; itself where there is one."""
    if process_count() == 1:
        return objective
    return DistributedDataParallel(objective, find_unused_parameters=skips_networks)


def first_says(values: Tensor) -> Tensor:
    """What process 0 has, on the CPU: clocks differ between processes, and all must end at one step."""
    if process_count() > 1:
        dist.broadcast(values, 0)
    return values


def mean_of_all(values: Tensor) -> Tensor:
    """Mean over processes."""
    if process_count() > 1:
        dist.all_reduce(values)
        values = values / process_count()
    return values
