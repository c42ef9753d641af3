#!/usr/bin/env python3
"""Bake people for `facerf train --stage portrait` until the time is up, and keep those that are finished.

    python tools/bake_people.py BANK --seconds 240 [--most 400] [--jobs N] [--heads-from builtin,ict.npz]

Those of an earlier call stay. Their number is printed, for `facerf train --bank BANK --heads NUMBER`.
"""

import argparse
import os
import time
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor, wait
from functools import partial
from multiprocessing import get_context
from pathlib import Path

from safetensors.torch import save_file
from torch import Tensor

from facerf_cli.relighting.models import SHIPPED_NETWORKS
from facerf_cli.run.workers import one_thread
from facerf_cli.synth.bank import file_of
from facerf_cli.synth.bank.backgrounds import BACKGROUND_HEAPS, BACKGROUND_MAPS, load_backgrounds
from facerf_cli.synth.bank.people import PeopleBankSettings, bake_person
from facerf_cli.synth.bank.proxies import look_at_photos


def bake(folder: Path, models: list[str], backgrounds: Tensor, until: float, number: int) -> int | None:
    """Bake a person and look at it; return its number, or None after the time `until`."""
    if time.time() > until:
        return None
    with one_thread():
        made = bake_person(models, 0, PeopleBankSettings(), number)
        for name, tensors in made.items():
            save_file(tensors, file_of(folder, name))
    look_at_photos(backgrounds, SHIPPED_NETWORKS, 0, sorted(folder.glob(f"photo_{number:05d}_*.safetensors")))
    return number


def files_of(folder: Path, number: int) -> Iterator[tuple[str, Path]]:
    """The files of a person, each with the words before the number."""
    for before in ("", "photo_", "seen_"):
        for path in folder.glob(f"{before}{number:05d}_*.safetensors"):
            yield before, path


def keep(folder: Path, finished: list[int]) -> None:
    """Number the finished people from 0 on, and delete what there is of others."""
    whole = {path for number in finished for _, path in files_of(folder, number)}
    for path in folder.iterdir():
        if path not in whole:
            path.unlink()
    for new, number in enumerate(sorted(finished)):
        for before, path in files_of(folder, number):
            path.rename(path.with_name(path.name.replace(f"{before}{number:05d}", f"{before}{new:05d}")))


def main() -> None:
    """Bake for a while."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n", 1)[0])
    parser.add_argument("bank", type=Path)
    parser.add_argument("--seconds", type=float, required=True)
    parser.add_argument("--most", type=int, default=400, help="people")
    parser.add_argument("--jobs", type=int, default=os.cpu_count())
    parser.add_argument("--heads-from", default="builtin", help="face models, separated by commas")
    options = parser.parse_args()
    until = time.time() + options.seconds
    folder = options.bank / "people"
    folder.mkdir(parents=True, exist_ok=True)
    maps = load_backgrounds(options.bank / "backgrounds.safetensors", BACKGROUND_MAPS, BACKGROUND_HEAPS, 0)
    pool = ProcessPoolExecutor(options.jobs, get_context("fork"))
    one = partial(bake, folder, options.heads_from.split(","), maps, until)
    before = len({path.name.split("_")[0] for path in folder.glob("[0-9]*.safetensors")})
    numbers = range(before, max(before, options.most))
    done, _ = wait([pool.submit(one, number) for number in numbers], options.seconds)
    for process in list(pool._processes.values()):
        process.kill()
    finished = [*range(before), *(number for one in done if (number := one.result()) is not None)]
    keep(folder, finished)
    print(len(finished))


if __name__ == "__main__":
    main()
