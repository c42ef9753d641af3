"""`facerf relight-dataset`: training pairs from a prepared dataset under environment maps."""

from dataclasses import replace
from pathlib import Path
from typing import Annotated

import typer

from facerf_cli.batch.settings import BatchOptions
from facerf_cli.cli.options import settings_of
from facerf_cli.dataset.settings import PairSettings
from facerf_cli.option import Without


def relight_dataset(
    context: typer.Context,
    dataset: Annotated[
        Path,
        typer.Argument(metavar="DATASET", help="Folder of `facerf prepare-dataset`.", show_default=False),
    ],
    pairs: PairSettings,
    batch: Annotated[BatchOptions, Without("output", "name")],
) -> None:
    """Relight a prepared dataset under environment maps, as pairs for `facerf train --dataset`.

    DATASET/relit/pairs.jsonl gets one row per pair: a subject, a camera, an environment map and its rotation,
    and the light and camera to predict. The row reproduces the image bit for bit. Row n of a subject depends
    only on --seed, n and the maps, so a larger --per-subject adds pairs without changing others. Sources are
    half-float EXRs, DATASET/relit/SUBJECT/00000.exr and so on, exposed so that the map's mean radiance is
    near 1 (exposure_ev).

    --dry-run estimates the size and time of the pairs by making some: at the paper's scale (350 subjects, 8
    cameras, 512 pixels) about 310 GB and 6 hours of one core. --lazy writes .7 GB of recipes and weights
    instead, and training sums the stacks.
    """
    from facerf_cli.dataset.pairs import RELIT
    from facerf_cli.dataset.relight_subjects import relight_subjects

    batch = replace(batch, output=dataset / RELIT)
    raise typer.Exit(relight_subjects(dataset, pairs, batch, settings_of(context)))
