"""`facerf segment`: who and what a photo shows: matte and classes of a person, as files."""

from dataclasses import dataclass
from pathlib import Path

import typer

from facerf_cli.cli.batch import BatchOptions, Outcome, run_batch
from facerf_cli.cli.inputs import Item
from facerf_cli.cli.options import (
    DryRunOption,
    InputColourspaceOption,
    InputsArgument,
    JobsOption,
    NameOption,
    OutputOption,
    OverwriteOption,
    settings_of,
)
from facerf_cli.cli.photo_options import FaceOption, LandmarksFromOption, LandmarksOption, PhotoOptions
from facerf_cli.cli.recipe import OneRecipe

_OUTPUTS = ("_segment.exr", "_person.png", "_overlay.jpg", "_landmarks.json")


@dataclass(frozen=True)
class Segment:
    """Segments one item and writes it; settings only."""

    photo: PhotoOptions

    def outputs_of(self, item: Item) -> list[Path]:
        """Every file of an item's (first) face."""
        return [item.output(self.photo.first_tag + ending) for ending in _OUTPUTS]

    def __call__(self, item: Item) -> Outcome:
        """Segment the person of every chosen face."""
        from facerf_cli.cli.items.segment_photos import write_segments

        tags, facts = write_segments(item, self.photo)
        return Outcome([item.output(tag + ending) for tag in tags for ending in _OUTPUTS], facts)


def segment(
    context: typer.Context,
    inputs: InputsArgument,
    output: OutputOption,
    face: FaceOption = "largest",
    landmarks: LandmarksOption = None,
    landmarks_from: LandmarksFromOption = "facerf",
    input_colourspace: InputColourspaceOption = None,
    name: NameOption = None,
    overwrite: OverwriteOption = "changed",
    dry_run: DryRunOption = False,
    jobs: JobsOption = 1,
) -> None:
    """Cut people out of photos: matte, hair, skin, garment and other classes, and landmarks.

    For each photo: _segment.exr (RGBA: the person without the background's colour, premultiplied; layers
    'person.A' and 'class.skin', 'class.hair', 'class.ears', 'class.neck', 'class.garment' and others, 0 to 1,
    which sum to the matte), _person.png (the person over nothing), _overlay.jpg (classes and landmarks over
    the photo), _landmarks.json (for --landmarks). The report says how sure facerf is of each photo.
    """
    photo = PhotoOptions(
        settings_of(context),
        input_colourspace,
        face=face,
        landmarks=landmarks,
        landmarks_from=landmarks_from,
    )
    photo.check()
    work = Segment(photo)
    options = BatchOptions(output, overwrite, dry_run, jobs)
    code = run_batch(
        "segment", inputs, work, work.outputs_of, options, photo.settings, OneRecipe(work), name=name
    )
    raise typer.Exit(code)
