"""Banks of training data: folders of safetensors."""

from collections.abc import Callable, Iterable, Sequence
from functools import partial
from pathlib import Path
from typing import TypeVar

import torch
from safetensors.torch import save_file
from torch import Tensor

from facerf_cli.files.atomic import atomic_path
from facerf_cli.run.workers import in_shards

T = TypeVar("T")
Entries = Iterable[tuple[Path, dict[str, Tensor]]]


def fill(
    make: Callable[[T], Entries], items: Sequence[T], jobs: int, metadata: dict[str, str] | None = None
) -> None:
    """Write the files that `make` gives for each item, by `jobs` processes of one thread."""
    in_shards(partial(_fill_shard, make, metadata), list(items), jobs)


def _fill_shard(make: Callable[[T], Entries], metadata: dict[str, str] | None, items: list[T]) -> None:
    torch.set_num_threads(1)
    for item in items:
        for path, tensors in make(item):
            with atomic_path(path) as temporary:
                save_file(tensors, temporary, metadata=metadata)
