"""`facerf relight-dataset`: subjects of a prepared dataset under environment maps, as pairs to train on."""

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from facerf_cli.cli.batch import BatchOptions, Item, Outcome, collect_items, run_items
from facerf_cli.cli.lights import MAP_SUFFIXES
from facerf_cli.cli.options import DryRunOption, OverwriteOption, Settings, settings_of, workers_of
from facerf_cli.errors import UsageError
from facerf_cli.logs import STDERR
from facerf_cli.workers import process_died, spread

if TYPE_CHECKING:
    from facerf_cli.dataset.dataset import Dataset


def relight_dataset(
    context: typer.Context,
    dataset: Annotated[
        Path,
        typer.Argument(metavar="DATASET", help="Folder by `facerf prepare-dataset`.", show_default=False),
    ],
    envmaps: Annotated[
        str,
        typer.Option(
            "--envmaps",
            metavar="DIR|FILE|procedural:N",
            help="Lat-long maps (.exr, .hdr) of any size: a folder (walked recursively), a file, or N maps "
            "drawn from --seed.",
            show_default=False,
        ),
    ],
    per_subject: Annotated[
        int, typer.Option("--per-subject", min=1, max=100_000, metavar="N", help="Pictures of each subject.")
    ] = 1000,
    lazy: Annotated[
        bool, typer.Option("--lazy", help="Write the recipes only; training relights as it goes.")
    ] = False,
    memory: Annotated[
        float, typer.Option(metavar="GB", min=0.1, help="For stacks and pictures, a job, about.")
    ] = 2.0,
    overwrite: OverwriteOption = False,
    dry_run: DryRunOption = False,
    jobs: Annotated[int, typer.Option("--jobs", "-j", min=1, help="Subjects worked on at a time.")] = 1,
) -> None:
    """Relight a prepared dataset under environment maps: the pairs that `facerf train --dataset` learns from.

    DATASET/relit/pairs.jsonl gets a row a pair: a subject, a camera, a map and how it is turned, and the
    light and camera that are to be predicted from it. The row alone gives the picture again, bit for bit. Row
    n of a subject depends on --seed, n and the maps, so a larger --per-subject adds pairs and changes none.
    Sources are half-float EXRs, DATASET/relit/SUBJECT/00000.exr and on; a map's exposure is brought near 1
    (exposure_ev).

    A source of 256 x 256 pixels takes 100 to 200 kB and about 25 ms of one core: 35 to 70 GB and 2.5 hours at
    the paper's scale (350 subjects). --lazy writes 250 bytes of recipe and 2 kB of weights for each instead,
    and training multiplies a stack's textures (15 MB at 128 texels) for every source that it draws.
    """
    from facerf_cli.dataset.dataset import read_dataset
    from facerf_cli.dataset.pairs import RELIT, draw_pairs, pairs_path
    from facerf_cli.dataset.weights import envmap_names, write_pairs
    from facerf_cli.synth.sky.skies import parse_envmaps

    settings = settings_of(context)
    if not math.isfinite(memory):
        raise UsageError(f"--memory {memory}: give a number of GB")
    prepared = read_dataset(dataset)
    output = dataset / RELIT
    if envmaps.startswith("procedural:"):
        names = envmap_names(parse_envmaps(envmaps, settings.seed))
    elif not Path(envmaps).exists():
        raise UsageError(f"--envmaps {envmaps}: no such folder; give one of lat-long maps, or procedural:N")
    else:
        names = envmap_names([item.input_path for item in collect_items([envmaps], output, MAP_SUFFIXES)])
    pairs = draw_pairs(prepared, names, per_subject, settings.seed)
    if not pairs:
        raise UsageError(f"{dataset}: no subject is in a split; run prepare-dataset with another --split")
    if not dry_run:
        write_pairs(prepared, pairs, overwrite, _Spread(jobs, settings))
    if lazy:
        print(pairs_path(prepared))
        return
    work = _Relight(prepared, per_subject, int(memory * 2**30), overwrite)
    subjects = dict.fromkeys(pair.subject for pair in pairs)
    items = [Item(dataset / "olat" / name, output / name, name) for name in subjects]
    options = BatchOptions(output, overwrite, dry_run, jobs)
    raise typer.Exit(run_items("relight-dataset", items, work, work.outputs_of, options, settings))


@dataclass(frozen=True)
class _Relight:
    """Relights one subject."""

    dataset: "Dataset"
    per_subject: int
    memory_bytes: int
    overwrite: bool

    def outputs_of(self, item: Item) -> list[Path]:
        """The sources of its pairs."""
        from facerf_cli.dataset.pairs import image_path

        return [image_path(self.dataset, item.name, index) for index in range(self.per_subject)]

    def __call__(self, item: Item) -> Outcome:
        """Write the sources that are missing."""
        from facerf_cli.dataset.relight import relight_subject
        from facerf_cli.dataset.weights import load_pairs

        pairs, weights = load_pairs(self.dataset)[item.name]
        made = relight_subject(self.dataset, pairs, weights, self.memory_bytes, self.overwrite)
        return Outcome(self.outputs_of(item), {"pictures": len(pairs), "made": made})


@dataclass(frozen=True)
class _Spread:
    """`map` with a bar, by as many workers as were asked for."""

    jobs: int
    settings: Settings

    def __call__(self, work: Callable[[Any], Any], items: Sequence[Any]) -> Iterator[Any]:
        from rich.progress import track

        if self.settings.shard.of > 1:  # shards would get in each other's way
            raise UsageError(
                "--shard: the pairs are not drawn; give this line once with --lazy and no --shard"
            )
        results = spread(work, items, workers_of(self.settings, self.jobs), _died)
        shown = STDERR.is_terminal and self.settings.verbosity >= 0 and not self.settings.log_json
        return iter(track(results, "maps", len(items), console=STDERR, transient=True, disable=not shown))


def _died(item: Any, error: Exception) -> str:
    return f"{item.name}: {process_died(error)}"
