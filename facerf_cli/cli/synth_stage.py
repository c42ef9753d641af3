"""`facerf synth-stage`: render synthetic people in a virtual light stage."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

import typer

from facerf_cli.batch.inputs import Item
from facerf_cli.batch.run import Job, Outcome, run_items, sums_up
from facerf_cli.batch.settings import BatchOptions
from facerf_cli.cli.options import settings_of
from facerf_cli.option import Without
from facerf_cli.synth.stage_settings import StageSettings


@dataclass(frozen=True)
class Photograph(Job):
    """Renders the captures of synthetic people."""

    stage: StageSettings
    verb = "synth-stage"

    def outputs_of(self, item: Item) -> list[Path]:
        """Return the person's folder."""
        return [item.output_base]

    def __call__(self, item: Item) -> Outcome:
        """Draw and render a person."""
        from facerf_cli.run.workers import one_thread
        from facerf_cli.synth.bank.heads import cached_face_model
        from facerf_cli.synth.person import draw_person
        from facerf_cli.synth.stage import write_subject

        model = cached_face_model(self.stage.face_model)
        with one_thread():
            subject = draw_person(model, int(item.name), self.stage.seed, self.stage.size_px)
            write_subject(item.output_base, subject, self.stage)
        return Outcome(self.outputs_of(item), {"traits": subject.traits})


def synth_stage(
    context: typer.Context,
    subjects: Annotated[
        int,
        typer.Option(
            min=1,
            max=9999,
            metavar="N",
            help="Number of people.",
            rich_help_panel="People and stage",
        ),
    ] = 10,
    *,
    stage: StageSettings,
    batch: Annotated[BatchOptions, Without("name")],
) -> None:
    """Render synthetic people in a light stage: one light at a time, several cameras, one exposure.

    The capture, for `facerf prepare-dataset`, has stage.json and SUBJECT/CAMERA/LIGHT.exr in half floats,
    scene-linear Rec.709. Person number n depends only on --seed, n and the face model, so a larger --subjects
    adds people without changing others.
    """
    from facerf_cli.synth.bank.heads import cached_face_model
    from facerf_cli.synth.stage import close_capture, open_capture

    settings = settings_of(context)
    stage = replace(stage, seed=settings.seed)
    cached_face_model(stage.face_model)  # raises for an invalid model before anything is written
    folders = [batch.output / f"{index:04d}" for index in range(subjects)]
    items = [Item(folder, folder, folder.name) for folder in folders]
    photograph = Photograph(stage)
    if not batch.dry_run:
        open_capture(batch.output, stage)
    code = run_items(photograph, items, batch, settings)
    if not batch.dry_run and sums_up(items, photograph.outputs_of, batch):
        close_capture(batch.output, stage)
    raise typer.Exit(code)
