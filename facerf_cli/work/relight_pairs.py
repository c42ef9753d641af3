"""One run of `facerf relight-dataset`: draw pairs, compute their weights, relight each subject."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rich.progress import track

from facerf_cli.batch.inputs import Item, collect_items
from facerf_cli.batch.report import Outcome
from facerf_cli.batch.run import BatchOptions, run_items
from facerf_cli.batch.settings import Settings, workers_of
from facerf_cli.cli.lights import MAP_SUFFIXES
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
from facerf_cli.run import memory
from facerf_cli.run.logs import STDERR
from facerf_cli.run.workers import process_died, spread
from facerf_cli.synth.sky.skies import parse_envmaps


def relight_subjects(folder: Path, wanted: PairSettings, batch: BatchOptions, settings: Settings) -> int:
    """Write the pairs and, unless lazy, the sources of the dataset in a folder; return the exit code."""
    dataset, overwrite = read_dataset(folder), batch.overwrite == "always"
    names = _envmap_names(wanted.envmaps, batch.output, settings.seed)
    pairs = draw_pairs(dataset, names, wanted.per_subject, settings.seed)
    if not pairs:
        raise UsageError(f"{folder}: no subject is in a split; run prepare-dataset with another --split")
    if not batch.dry_run:
        write_pairs(dataset, pairs, overwrite, _Spread(batch.jobs, settings))
    if wanted.lazy:
        print(pairs_path(dataset))
        return 0
    work = _Relight(dataset, wanted.per_subject, overwrite)
    subjects = dict.fromkeys(pair.subject for pair in pairs)
    items = [Item(folder / "olat" / name, batch.output / name, name) for name in subjects]
    return run_items("relight-dataset", items, work, work.outputs_of, batch, settings)


def _envmap_names(envmaps: str, output: Path, seed: int) -> list[str]:
    if envmaps.startswith("procedural:"):
        return envmap_names(parse_envmaps(envmaps, seed))
    if not Path(envmaps).exists():
        raise UsageError(f"--envmaps {envmaps}: no such folder; give one of lat-long maps, or procedural:N")
    return envmap_names([item.input_path for item in collect_items([envmaps], output, MAP_SUFFIXES)])


@dataclass(frozen=True)
class _Relight:
    """Relights one subject."""

    dataset: Dataset
    per_subject: int
    overwrite: bool

    def outputs_of(self, item: Item) -> list[Path]:
        """Paths of the sources of the subject's pairs."""
        return [image_path(self.dataset, item.name, index) for index in range(self.per_subject)]

    def __call__(self, item: Item) -> Outcome:
        """Write the sources that are missing."""
        pairs, weights = load_pairs(self.dataset)[item.name]
        made = relight_subject(self.dataset, pairs, weights, memory.limit_bytes(), self.overwrite)
        return Outcome(self.outputs_of(item), {"pictures": len(pairs), "made": made})


@dataclass(frozen=True)
class _Spread:
    """`map` over envmaps by the workers of --jobs or --ray, with a progress bar."""

    jobs: int
    settings: Settings

    def __call__(self, work: Callable[[Any], Any], items: Sequence[Any]) -> Iterator[Any]:
        if self.settings.shard.of > 1:  # shards would write the same pairs at the same time
            raise UsageError(
                "--shard: the pairs are not drawn yet; run once with --lazy and without --shard first"
            )
        results = spread(work, items, workers_of(self.settings, self.jobs), _died)
        shown = STDERR.is_terminal and self.settings.verbosity >= 0 and not self.settings.log_json
        return iter(track(results, "maps", len(items), console=STDERR, transient=True, disable=not shown))


def _died(item: Any, error: Exception) -> str:
    return f"{item.name}: {process_died(error)}"
