"""`facerf synth-stage`: photograph synthetic people in a virtual light stage."""

from dataclasses import replace
from typing import Annotated

import typer

from facerf_cli.batch.run import BatchOptions
from facerf_cli.cli.options import settings_of
from facerf_cli.errors import UsageError
from facerf_cli.option import IMAGE, Without
from facerf_cli.synth.stage_settings import StageSettings


def synth_stage(
    context: typer.Context,
    subjects: Annotated[
        int,
        typer.Option(
            min=1,
            max=9999,
            metavar="N",
            help="Photograph so many people.",
            rich_help_panel="People and stage",
        ),
    ] = 10,
    *,
    stage: StageSettings,
    transport: Annotated[
        bool,
        typer.Option(
            "--transport",
            help="Keep the baked transport in transport/SUBJECT.safetensors.",
            rich_help_panel=IMAGE,
        ),
    ] = False,
    batch: Annotated[BatchOptions, Without("name")],
) -> None:
    """Photograph synthetic people in a light stage: one light at a time, several cameras, one exposure.

    Writes a capture for `facerf prepare-dataset`: stage.json, and SUBJECT/CAMERA/LIGHT.exr in half floats,
    scene-linear Rec.709. SUBJECT/truth/CAMERA.exr has the true matte, classes, surface and material.
    Person number n depends on --seed, n and the face model alone, so a larger --subjects adds people and
    changes none.
    """
    if transport and stage.renderer != "bake":
        raise UsageError("--transport: --renderer mitsuba bakes no transport; give --renderer bake")
    from facerf_cli.work.synth_subjects import photograph_people

    settings = settings_of(context)
    stage = replace(stage, seed=settings.seed)
    raise typer.Exit(photograph_people(subjects, stage, transport, batch, settings))
