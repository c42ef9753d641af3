"""One run of `facerf relight-dataset`: draw pairs, compute their weights, relight each subject."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rich.progress import track

from facerf_cli import memory
from facerf_cli.cli.batch import BatchOptions, run_items
from facerf_cli.cli.inputs import Item, collect_items
from facerf_cli.cli.lights import MAP_SUFFIXES
from facerf_cli.cli.options import Settings, workers_of
from facerf_cli.cli.relight_dataset import RelightDataset
from facerf_cli.cli.report import Outcome
from facerf_cli.dataset.dataset import Dataset, read_dataset
from facerf_cli.dataset.pairs import RELIT, draw_pairs, image_path, pairs_path
from facerf_cli.dataset.relight import relight_subject
from facerf_cli.dataset.weights import envmap_names, load_pairs, write_pairs
from facerf_cli.errors import UsageError
from facerf_cli.logs import STDERR
from facerf_cli.synth.sky.skies import parse_envmaps
from facerf_cli.workers import process_died, spread


def relight_subjects(options: RelightDataset) -> int:
    """Write the pairs and, unless lazy, the sources of a dataset; return the exit code."""
    dataset = read_dataset(options.dataset)
    output = options.dataset / RELIT
    names = _envmap_names(options, output)
    pairs = draw_pairs(dataset, names, options.per_subject, options.settings.seed)
    if not pairs:
        raise UsageError(
            f"{options.dataset}: no subject is in a split; run prepare-dataset with another --split"
        )
    if not options.dry_run:
        write_pairs(dataset, pairs, options.overwrite == "always", _Spread(options.jobs, options.settings))
    if options.lazy:
        print(pairs_path(dataset))
        return 0
    work = _Relight(dataset, options.per_subject, options.overwrite == "always")
    subjects = dict.fromkeys(pair.subject for pair in pairs)
    items = [Item(options.dataset / "olat" / name, output / name, name) for name in subjects]
    batch = BatchOptions(output, options.overwrite, options.dry_run, options.jobs)
    return run_items("relight-dataset", items, work, work.outputs_of, batch, options.settings)


def _envmap_names(options: RelightDataset, output: Path) -> list[str]:
    if options.envmaps.startswith("procedural:"):
        return envmap_names(parse_envmaps(options.envmaps, options.settings.seed))
    if not Path(options.envmaps).exists():
        raise UsageError(
            f"--envmaps {options.envmaps}: no such folder; give one of lat-long maps, or procedural:N"
        )
    items = collect_items([options.envmaps], output, MAP_SUFFIXES)
    return envmap_names([item.input_path for item in items])


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
