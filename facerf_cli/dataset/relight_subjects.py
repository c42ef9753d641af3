"""Write the pairs and sources of all subjects of a dataset, for `facerf relight-dataset`."""

import logging
import os
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

from facerf_cli.batch.inputs import MAP_SUFFIXES, Item, collect_items
from facerf_cli.batch.run import Job, Outcome, run_items
from facerf_cli.batch.settings import BatchOptions, Settings
from facerf_cli.dataset.dataset import Dataset, read_dataset
from facerf_cli.dataset.pairs import (
    draw_pairs,
    image_path,
    load_pairs,
    pairs_path,
    relight_subject,
    write_pairs,
)
from facerf_cli.dataset.settings import PairSettings
from facerf_cli.dataset.weights import envmap_names
from facerf_cli.errors import UsageError
from facerf_cli.run.logs import LOGGER_NAME
from facerf_cli.run.workers import process_died, spread
from facerf_cli.synth.sky.skies import parse_envmaps

T = TypeVar("T")
R = TypeVar("R")
_DRAWN = "procedural:"
_TEST_MAPS_OF = 10  # one in ten maps is only for the split test
log = logging.getLogger(LOGGER_NAME)


def relight_subjects(folder: Path, wanted: PairSettings, batch: BatchOptions, settings: Settings) -> int:
    """Write the pairs and, unless lazy, the sources of the dataset in a folder; return the exit code."""
    dataset, overwrite = read_dataset(folder), batch.overwrite == "always"
    maps, test_maps = _maps_of_splits(dataset, wanted, batch.output, settings.seed)
    pairs = draw_pairs(dataset, maps, wanted.per_subject, settings.seed, test_maps)
    if not pairs:
        raise UsageError(f"{folder}: no subject is in a split; run prepare-dataset with another --split")
    if batch.dry_run:
        todo = [pair for pair in pairs if overwrite or not image_path(dataset, *pair.key).exists()]
        sources = 0 if wanted.lazy else len(todo)
        log.info("%d recipes, %d sources of %d px", len(pairs), sources, dataset.crop_px)
    else:
        write_pairs(dataset, pairs, overwrite, partial(_spread_maps, batch, settings))
        if test_maps != maps:
            log.info("maps: %d, and %d others only for the split test", len(maps), len(test_maps))
    if wanted.lazy:
        print(pairs_path(dataset))
        return 0
    work = _Relight(dataset, wanted.per_subject, overwrite)
    subjects = dict.fromkeys(pair.subject for pair in pairs)
    items = [Item(folder / "olat" / name, batch.output / name, name) for name in subjects]
    return run_items(work, items, batch, settings)


def _maps_of_splits(
    dataset: Dataset, wanted: PairSettings, output: Path, seed: int
) -> tuple[list[str], list[str]]:
    """Return the names of the maps for training and validation, and for the test; they may not share any.

    Procedural maps of the test follow the ones of --envmaps in their sequence.
    """
    maps = _envmap_names("--envmaps", wanted.envmaps, output, seed)
    if wanted.envmaps_test is not None:
        drawn = len(maps) if wanted.envmaps.startswith(_DRAWN) else 0
        test_maps = _envmap_names("--envmaps-test", wanted.envmaps_test, output, seed, drawn)
        if shared := sorted(
            {os.path.realpath(name) for name in maps} & set(map(os.path.realpath, test_maps))
        ):
            raise UsageError(
                f"--envmaps-test {wanted.envmaps_test}: has {len(shared)} maps of --envmaps, such as "
                f"{Path(shared[0]).name}; use other maps for the test"
            )
        return maps, test_maps
    if not dataset.splits["test"] or not (dataset.splits["train"] or dataset.splits["validation"]):
        return maps, maps
    if len(maps) < 2:
        raise UsageError(
            f"--envmaps {wanted.envmaps}: only one map, but the split test needs others; use --envmaps-test"
        )
    test_maps = maps[::_TEST_MAPS_OF]
    return [name for index, name in enumerate(maps) if index % _TEST_MAPS_OF], test_maps


def _envmap_names(option: str, envmaps: str, output: Path, seed: int, first: int = 0) -> list[str]:
    """Return the names of an option's maps; procedural ones begin at number `first` of their sequence."""
    if envmaps.startswith(_DRAWN):
        maps = parse_envmaps(envmaps, seed)
        return envmap_names(replace(maps, maps=first + len(maps)))[first:]
    if not Path(envmaps).exists():
        raise UsageError(
            f"{option} {envmaps}: no such folder; use a folder of lat-long maps, or procedural:N"
        )
    return envmap_names([item.input_path for item in collect_items([envmaps], output, MAP_SUFFIXES)])


@dataclass(frozen=True)
class _Relight(Job):
    verb = "relight-dataset"

    dataset: Dataset
    per_subject: int
    overwrite: bool

    def outputs_of(self, item: Item) -> list[Path]:
        """Return the paths of the sources of the subject's pairs."""
        return [image_path(self.dataset, item.name, index) for index in range(self.per_subject)]

    def __call__(self, item: Item) -> Outcome:
        """Write the missing sources."""
        pairs, weights = load_pairs(self.dataset)[item.name]
        made = relight_subject(self.dataset, pairs, weights, self.overwrite)
        return Outcome(self.outputs_of(item), {"pictures": len(pairs), "made": made})


def _spread_maps(
    batch: BatchOptions, settings: Settings, work: Callable[[T], R], maps: Sequence[T]
) -> Iterator[R]:
    if batch.shard.of > 1:  # shards would write the same pairs at the same time
        raise UsageError(
            "--shard: the pairs are not drawn yet; first run once with --lazy and without --shard"
        )
    return spread(work, maps, batch.workers(settings), _map_died, "maps")


def _map_died(task: Any, error: Exception) -> Any:
    return f"{task.name}: {process_died(error)}"
