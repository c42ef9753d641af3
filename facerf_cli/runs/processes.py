"""Training by several processes: `torchrun --nproc-per-node N -m facerf_cli train ...`."""

import datetime
import os
from collections.abc import Iterator
from contextlib import contextmanager

import torch
import torch.distributed as dist
from torch import Tensor, nn
from torch.nn.parallel import DistributedDataParallel

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
