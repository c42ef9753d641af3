"""`facerf relight-dataset`: relight a prepared dataset under environment maps, into pairs to train on."""

from dataclasses import replace
from pathlib import Path
from typing import Annotated

import typer

from facerf_cli.batch.run import BatchOptions
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

    A source of 256 x 256 pixels takes 100 to 200 kB and about 25 ms of one core: 35 to 70 GB and 2.5 hours at
    the paper's scale (350 subjects). --lazy writes 250 bytes of recipe and 2 kB of weights for each instead,
    and training multiplies a stack's textures (15 MB at 128 texels) for every source that it draws.
    """
    from facerf_cli.dataset.pairs import RELIT
    from facerf_cli.work.prepare import relight_subjects

    batch = replace(batch, output=dataset / RELIT)
    raise typer.Exit(relight_subjects(dataset, pairs, batch, settings_of(context)))
