"""One run of `facerf synth-stage`: a capture, and the photographs of each person."""

from dataclasses import dataclass
from pathlib import Path

from facerf_cli.batch.inputs import Item
from facerf_cli.batch.run import BatchOptions, Job, Outcome, run_items, sums_up
from facerf_cli.batch.settings import Settings
from facerf_cli.run.workers import one_thread
from facerf_cli.synth.bank.heads import cached_face_model
from facerf_cli.synth.path_tracer import load_mitsuba
from facerf_cli.synth.stage import close_capture, open_capture, write_subject
from facerf_cli.synth.stage_settings import StageSettings
from facerf_cli.synth.subjects import draw_subject


def photograph_people(
    subjects: int, stage: StageSettings, transport: bool, batch: BatchOptions, settings: Settings
) -> int:
    """Write a capture of synthetic people; return the exit code."""
    cached_face_model(stage.face_model)  # raises for an invalid model before anything is written
    if stage.renderer == "mitsuba":
        load_mitsuba()
    folders = [batch.output / f"{index:04d}" for index in range(subjects)]
    items = [Item(folder, folder, folder.name) for folder in folders]
    photograph = _Photograph(stage, batch.output / "transport" if transport else None)
    if not batch.dry_run:
        open_capture(batch.output, stage)
    code = run_items(photograph, items, batch, settings)
    if not batch.dry_run and sums_up(items, photograph.outputs_of, batch):
        close_capture(batch.output, stage)
    return code


@dataclass(frozen=True)
class _Photograph(Job):
    """Photographs one person."""

    verb = "synth-stage"

    stage: StageSettings
    transport: Path | None

    def outputs_of(self, item: Item) -> list[Path]:
        """The person's folder, and the baked transport if it is kept."""
        transport = self._transport_path(item)
        return [item.output_base] if transport is None else [item.output_base, transport]

    def __call__(self, item: Item) -> Outcome:
        """Draw and photograph a person."""
        model = cached_face_model(self.stage.face_model)
        with one_thread():
            subject = draw_subject(model, int(item.name), self.stage.seed, self.stage.size_px)
            write_subject(item.output_base, subject, self.stage, self._transport_path(item))
        return Outcome(self.outputs_of(item), {"traits": subject.traits})

    def _transport_path(self, item: Item) -> Path | None:
        return self.transport / f"{item.name}.safetensors" if self.transport else None
