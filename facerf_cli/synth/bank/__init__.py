"""Banks of training data: folders of safetensors, a file or more a person."""

from collections.abc import Callable, Iterable
from functools import partial
from pathlib import Path

import torch
from safetensors.torch import save_file
from torch import Tensor

from facerf_cli.errors import InputError
from facerf_cli.files.atomic import atomic_path
from facerf_cli.run.workers import in_shards

Files = dict[str, dict[str, Tensor]]  # tensors by the names of files, without ending


def fill(
    folder: Path,
    make: Callable[[int], Files],
    people: Iterable[int],
    jobs: int,
    metadata: dict[str, str] | None = None,
    last: str = "{:05d}",
) -> None:
    """Write the files that `make` gives for each person, by `jobs` processes of one thread.

    People whose file `last` exists are finished and kept.
    """
    folder.mkdir(parents=True, exist_ok=True)
    missing = [index for index in people if not file_of(folder, last.format(index)).exists()]
    in_shards(partial(_fill_shard, folder, make, metadata), missing, jobs)


def _fill_shard(
    folder: Path, make: Callable[[int], Files], metadata: dict[str, str] | None, people: list[int]
) -> None:
    torch.set_num_threads(1)
    for index in people:
        for name, tensors in make(index).items():
            with atomic_path(file_of(folder, name)) as temporary:
                save_file(tensors, temporary, metadata=metadata)


def file_of(folder: Path, name: str) -> Path:
    return folder / f"{name}.safetensors"


def files_in(folder: Path, otherwise: str = "") -> list[Path]:
    """Return all files of people; if there are none, raise an InputError that ends with `otherwise`."""
    files = sorted(folder.glob("[0-9]*.safetensors"))
    if otherwise and not files:
        raise InputError(f"{folder}: {otherwise}")
    return files


def split_people(count: int, held_out: int) -> tuple[list[int], list[int]]:
    """Indices of the people to train on, and of the first `held_out` ones."""
    return list(range(held_out, count)), list(range(held_out))
