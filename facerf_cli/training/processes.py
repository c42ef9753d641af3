"""Processes of torchrun that train one run together (docs/clusters.md); a single process has rank 0."""

import datetime
import os
from collections.abc import Iterator
from contextlib import contextmanager

import torch
import torch.distributed as dist
from torch import Tensor, nn
from torch.nn.parallel import DistributedDataParallel

from facerf_cli.errors import FacerfError

_TIMEOUT = datetime.timedelta(hours=24)  # others wait while the first process bakes heads or validates


@contextmanager
def joined_processes() -> Iterator[None]:
    """Join torchrun's group of processes, if the environment describes one, and leave it at the end.

    Raises FacerfError if another process is lost.
    """
    if int(os.environ.get("WORLD_SIZE", "1")) < 2 or dist.is_initialized():
        yield
        return
    # If it were imported once the group exists, defaults of its functions would keep the group, whose threads
    # would outlive the interpreter and abort the process.
    import torch.distributed.nn

    backend = "cpu:gloo,cuda:nccl" if torch.cuda.is_available() else "gloo"
    dist.init_process_group(backend, timeout=_TIMEOUT)
    try:
        yield
        _meet()  # a process that leaves while others still talk to it can be aborted
    except RuntimeError as error:
        if not isinstance(error, dist.DistError) and "gloo" not in str(error):
            raise
        ended = "another process of this run ended; see its own message"
        raise FacerfError(f"{ended}, then run the same command with --resume") from error
    finally:
        dist.destroy_process_group()


def process_count() -> int:
    """Return the number of training processes."""
    return dist.get_world_size() if dist.is_initialized() else 1


def process_rank() -> int:
    """Return the index of this process; only process 0 writes files."""
    return dist.get_rank() if dist.is_initialized() else 0


def process_device(device: torch.device) -> torch.device:
    """Return the GPU of this process if a machine has several; otherwise `device`."""
    if device.type != "cuda" or process_count() == 1:
        return device
    own = torch.device("cuda", int(os.environ.get("LOCAL_RANK", "0")))
    torch.cuda.set_device(own)
    return own


@contextmanager
def first_process_first() -> Iterator[None]:
    """Run a block in process 0, then in all others, which find the files that it made."""
    if process_rank() > 0:
        _meet()
    yield
    if process_rank() == 0:
        _meet()


def _meet() -> None:
    """Wait for all processes, on the CPU; a barrier would need a GPU."""
    mean_over_processes(torch.zeros(1))


def distributed(objective: nn.Module, skips_networks: bool) -> nn.Module:
    """Wrap the objective so that gradients are averaged over all processes; not needed for one process."""
    if process_count() == 1:
        return objective
    return DistributedDataParallel(objective, find_unused_parameters=skips_networks)


def broadcast_from_first(values: Tensor) -> Tensor:
    """Return the values of process 0."""
    if process_count() > 1:
        dist.broadcast(values, 0)
    return values


def mean_over_processes(values: Tensor) -> Tensor:
    if process_count() > 1:
        dist.all_reduce(values)
        values = values / process_count()
    return values
