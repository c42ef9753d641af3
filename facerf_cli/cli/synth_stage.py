"""`facerf synth-stage`: a light stage in software."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from facerf_cli.cli.batch import BatchOptions, Item, Outcome, run_items, sums_up
from facerf_cli.cli.options import DryRunOption, OutputOption, OverwriteOption, settings_of
from facerf_cli.errors import UsageError

if TYPE_CHECKING:
    from facerf_cli.synth.stage import StageSettings


def synth_stage(
    context: typer.Context,
    output: OutputOption,
    subjects: Annotated[int, typer.Option(min=1, max=9999, help="People to photograph.")] = 10,
    size: Annotated[int, typer.Option(min=64, max=1024, metavar="PX", help="Side of a picture.")] = 256,
    face_model: Annotated[
        str,
        typer.Option(
            metavar="NAME|PATH",
            help="Face model that people are drawn from: builtin, or a .npz by `face-model import`.",
        ),
    ] = "builtin",
    renderer: Annotated[
        Literal["bake", "mitsuba"],
        typer.Option(
            help="bake: light transport baked once a person; mitsuba: path traced, slow, the truth."
        ),
    ] = "bake",
    lights: Annotated[int, typer.Option(min=4, max=1000, help="Lights, uniform on the sphere.")] = 150,
    transport: Annotated[
        bool, typer.Option("--transport", help="Keep the bake, in transport/SUBJECT.safetensors.")
    ] = False,
    jobs: Annotated[int, typer.Option("--jobs", "-j", min=1, help="People worked on at a time.")] = 1,
    overwrite: OverwriteOption = False,
    dry_run: DryRunOption = False,
) -> None:
    """Photograph synthetic people in a light stage: one light at a time, eight cameras, one exposure.

    Writes a capture that `facerf prepare-dataset` reads: stage.json, and SUBJECT/CAMERA/LIGHT.exr in half
    floats, scene-linear Rec.709. Person number n depends on --seed, n and the face model alone, so a larger
    --subjects adds people and changes none.
    """
    from facerf_cli.synth.path_tracer import load_mitsuba
    from facerf_cli.synth.stage import StageSettings, close_capture, open_capture
    from facerf_cli.synth.subjects import subject_model

    if transport and renderer != "bake":
        raise UsageError("--transport keeps the bake, and --renderer mitsuba makes none")
    subject_model(face_model)  # what is bad or missing is named before anything is written
    if renderer == "mitsuba":
        load_mitsuba()
    settings = settings_of(context)
    stage = StageSettings(size, face_model, renderer, lights, settings.seed)
    items = [
        Item(output / f"{index:04d}", output / f"{index:04d}", f"{index:04d}") for index in range(subjects)
    ]
    photograph = _Photograph(stage, output / "transport" if transport else None)
    if not dry_run:
        open_capture(output, stage)
    options = BatchOptions(output, overwrite, dry_run, jobs)
    code = run_items("synth-stage", items, photograph, photograph.outputs_of, options, settings)
    if not dry_run and sums_up(items, photograph.outputs_of, options, settings):
        close_capture(output, stage)
    raise typer.Exit(code)


@dataclass(frozen=True)
class _Photograph:
    """Photographs one person."""

    stage: "StageSettings"
    transport: Path | None

    def outputs_of(self, item: Item) -> list[Path]:
        """The person's folder, and the bake."""
        transport = self._transport_of(item)
        return [item.output_base] if transport is None else [item.output_base, transport]

    def __call__(self, item: Item) -> Outcome:
        from facerf_cli.synth.stage import write_subject
        from facerf_cli.synth.subjects import draw_subject, subject_model
        from facerf_cli.synth.threads import one_thread

        model = subject_model(self.stage.face_model)
        with one_thread():
            subject = draw_subject(model, int(item.name), self.stage.seed, self.stage.size_px)
            write_subject(item.output_base, subject, self.stage, self._transport_of(item))
        return Outcome(self.outputs_of(item), {"traits": subject.traits})

    def _transport_of(self, item: Item) -> Path | None:
        return self.transport / f"{item.name}.safetensors" if self.transport else None
