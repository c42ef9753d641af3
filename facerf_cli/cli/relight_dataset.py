"""`facerf relight-dataset`: relight a prepared dataset under environment maps, into pairs to train on."""

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
    """Relight a prepared dataset under environment maps, into the pairs of `facerf train --dataset`.

    DATASET/relit/pairs.jsonl gets a row a pair: a subject, a camera, an envmap and its rotation, and the
    light and camera to predict. The row alone reproduces the image, bit for bit. Row n of a subject depends
    on --seed, n and the envmaps, so a larger --per-subject adds pairs and changes none. Sources are
    half-float EXRs, DATASET/relit/SUBJECT/00000.exr and on, exposed so that the envmap's mean radiance is
    near 1 (exposure_ev).

    --dry-run says what the pairs take, by making some: at the paper's scale (350 subjects, 8 cameras, 512
    pixels) about 310 GB and 6 hours of a core. --lazy writes .7 GB of recipes and weights instead, and
    training sums stacks.
    """
    from facerf_cli.dataset.pairs import RELIT
    from facerf_cli.dataset.relight_subjects import relight_subjects

    batch = replace(batch, output=dataset / RELIT)
    raise typer.Exit(relight_subjects(dataset, pairs, batch, settings_of(context)))
