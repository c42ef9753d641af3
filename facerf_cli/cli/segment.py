"""`facerf segment`: who and what a photo shows: matte and classes of a person, as files."""

from dataclasses import dataclass, field
from pathlib import Path

import typer

from facerf_cli.batch.inputs import Item, file_pattern
from facerf_cli.batch.made_from import DigestOf, Recipe, recipe_of
from facerf_cli.batch.run import BatchOptions, Outcome, run_items
from facerf_cli.batch.settings import NOT_IN_RECIPE
from facerf_cli.cli.options import (
    DryRunOption,
    InputColourspaceOption,
    JobsOption,
    NameOption,
    OutputOption,
    OverwriteOption,
    settings_of,
)
from facerf_cli.cli.photo_options import FaceOption, LandmarksFromOption, LandmarksOption, PhotoOptions
from facerf_cli.cli.shots import (
    FRAMES_IN_A_ROW,
    NoCutsOption,
    PhotosArgument,
    SequenceOption,
    Shot,
    check_shots,
    collect_frames,
    follow_all,
    recipe_of_shots,
)

_OUTPUTS = ("_segment.exr", "_person.png", "_overlay.jpg", "_landmarks.json")


@dataclass(frozen=True)
class Segment:
    """Segments one item and writes it; settings only."""

    photo: PhotoOptions
    shots: tuple[Shot, ...] = field(default=(), metadata=NOT_IN_RECIPE)

    def outputs_of(self, item: Item) -> list[Path]:
        """Every file of an item's (first) face."""
        return [item.output(self.photo.first_tag + ending) for ending in _OUTPUTS]

    def recipes_of(self, digest_of: DigestOf) -> list[Recipe]:
        """The recipe of all outputs."""
        return [recipe_of(self, digest_of) | recipe_of_shots(self.shots, digest_of)]

    def __call__(self, item: Item) -> Outcome:
        """Segment the person of every chosen face."""
        from facerf_cli.work.segment_and_fit import write_segments

        tags, facts = write_segments(item, self.photo, self.shots)
        return Outcome([item.output(tag + ending) for tag in tags for ending in _OUTPUTS], facts)


def segment(
    context: typer.Context,
    inputs: PhotosArgument,
    output: OutputOption,
    face: FaceOption = "largest",
    landmarks: LandmarksOption = None,
    landmarks_from: LandmarksFromOption = "facerf",
    input_colourspace: InputColourspaceOption = None,
    name: NameOption = None,
    sequence: SequenceOption = False,
    no_cuts: NoCutsOption = False,
    overwrite: OverwriteOption = "changed",
    dry_run: DryRunOption = False,
    jobs: JobsOption = 1,
) -> None:
    """Cut people out of photos: matte, hair, skin, garment and other classes, and landmarks.

    For each photo: _segment.exr (RGBA: the person without the background's colour, premultiplied; layers
    'person.A' and 'class.skin', 'class.hair', 'class.ears', 'class.neck', 'class.garment' and others, 0 to 1,
    which sum to the matte), _person.png (the person over nothing), _overlay.jpg (classes and landmarks over
    the photo), _landmarks.json (for --landmarks). The report says how sure facerf is of each photo.

    Each frame of a film, or with --sequence of numbered images, is steadied by the frames around it.
    """
    photo = PhotoOptions(
        settings_of(context),
        input_colourspace,
        face=face,
        landmarks=landmarks,
        landmarks_from=landmarks_from,
    )
    photo.check()
    items, shots = collect_frames(inputs, output, photo.settings, sequence, file_pattern(name), not no_cuts)
    check_shots(shots, photo)
    work = Segment(photo, shots)
    options = BatchOptions(output, overwrite, dry_run, jobs, FRAMES_IN_A_ROW if shots else 1)

    def prepare() -> None:
        photo.preparation(dry_run, ("parsing",))()
        follow_all(shots, photo, dry_run)

    code = run_items(
        "segment", items, work, work.outputs_of, options, photo.settings, work.recipes_of, prepare
    )
    raise typer.Exit(code)
