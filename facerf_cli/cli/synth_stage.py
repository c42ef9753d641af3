"""`facerf synth-stage`: photograph synthetic people in a virtual light stage."""

from dataclasses import dataclass
from typing import Annotated, Literal

import typer

from facerf_cli.cli.batch import BatchOptions
from facerf_cli.cli.options import (
    BATCH,
    IMAGE,
    DryRunOption,
    OutputOption,
    OverwriteOption,
    Settings,
    settings_of,
)
from facerf_cli.errors import UsageError

_STAGE = "People and stage"
Renderer = Literal["bake", "mitsuba"]
Frame = Literal["head", "bust"]


@dataclass(frozen=True)
class SynthStage:
    """The options of a run; settings only."""

    subjects: int
    size_px: int
    face_model: str
    renderer: Renderer
    lights: int
    frame: Frame
    transport: bool
    batch: BatchOptions
    settings: Settings


def synth_stage(
    context: typer.Context,
    output: OutputOption,
    subjects: Annotated[
        int,
        typer.Option(min=1, max=9999, metavar="N", help="Photograph so many people.", rich_help_panel=_STAGE),
    ] = 10,
    face_model: Annotated[
        str,
        typer.Option(
            metavar="NAME|PATH",
            help="Draw people from this face model: builtin, or a .npz of `face-model import`.",
            rich_help_panel=_STAGE,
        ),
    ] = "builtin",
    lights: Annotated[
        int,
        typer.Option(
            min=4,
            max=1000,
            metavar="N",
            help="Use so many lights, uniform on the sphere.",
            rich_help_panel=_STAGE,
        ),
    ] = 150,
    size: Annotated[
        int,
        typer.Option(
            min=64,
            max=1024,
            metavar="PX",
            help="Write square images of this side.",
            rich_help_panel=IMAGE,
        ),
    ] = 256,
    frame: Annotated[
        Frame,
        typer.Option(
            help="Show the head down to the collar, or a bust down to the chest.", rich_help_panel=IMAGE
        ),
    ] = "head",
    renderer: Annotated[
        Renderer,
        typer.Option(
            help="Render with light transport baked once a person (bake), or by path tracing, slow and "
            "accurate (mitsuba).",
            rich_help_panel=IMAGE,
        ),
    ] = "bake",
    transport: Annotated[
        bool,
        typer.Option(
            "--transport",
            help="Keep the baked transport in transport/SUBJECT.safetensors.",
            rich_help_panel=IMAGE,
        ),
    ] = False,
    overwrite: OverwriteOption = "changed",
    dry_run: DryRunOption = False,
    jobs: Annotated[
        int,
        typer.Option(
            "--jobs", "-j", min=1, help="Photograph this many people at a time.", rich_help_panel=BATCH
        ),
    ] = 1,
) -> None:
    """Photograph synthetic people in a light stage: one light at a time, eight cameras, one exposure.

    Writes a capture for `facerf prepare-dataset`: stage.json, and SUBJECT/CAMERA/LIGHT.exr in half floats,
    scene-linear Rec.709. SUBJECT/truth/CAMERA.exr has the true matte, classes, surface and material.
    Person number n depends on --seed, n and the face model alone, so a larger --subjects adds people and
    changes none.
    """
    if transport and renderer != "bake":
        raise UsageError("--transport: --renderer mitsuba bakes no transport; give --renderer bake")
    from facerf_cli.cli.items.synth_subjects import photograph_people

    batch = BatchOptions(output, overwrite, dry_run, jobs)
    settings = settings_of(context)
    work = SynthStage(subjects, size, face_model, renderer, lights, frame, transport, batch, settings)
    raise typer.Exit(photograph_people(work))
