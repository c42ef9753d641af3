"""`facerf segment`: matte and classes of the people in a photo."""

from dataclasses import dataclass
from typing import Annotated

import typer

from facerf_cli.batch.inputs import Item
from facerf_cli.cli.options import FramesArgument
from facerf_cli.option import Only
from facerf_cli.work.photo_options import PhotoOptions
from facerf_cli.work.photo_work import FileOrFolder, PhotoWork, Written
from facerf_cli.work.shots import ShotOptions


@dataclass(frozen=True, kw_only=True)
class Segment(PhotoWork):
    """`facerf segment`."""

    photo: Annotated[
        PhotoOptions,
        Only("colourspace", "layer", "face", "landmarks", "person"),
    ]
    verb = "segment"
    endings = ("_segment.exr", "_person.png", "_overlay.jpg", "_landmarks.json")
    networks = frozenset({"parsing"})
    file_endings = ("_person.png", "_segment.exr")

    def write(self, item: Item) -> Written:
        """Segment the person of every chosen face."""
        from facerf_cli.work.segment import write_segments

        return write_segments(item, self.photo, self.shots)


def segment(inputs: FramesArgument, work: Segment, shots: ShotOptions, batch: FileOrFolder) -> None:
    """Cut people out of photos: matte, hair, skin, garment and other classes, and landmarks.

    Each photo gets _segment.exr (RGBA: the person without background colour, premultiplied; layers 0 to 1:
    'person.A', the matte, and its parts 'class.skin', 'class.hair', 'class.ears', 'class.neck',
    'class.garment' and others), _person.png (a transparent cut-out), _overlay.jpg (classes and landmarks over
    the photo) and _landmarks.json (for --landmarks). The report contains each photo's confidence. -o cut.png
    or cut.exr writes only the cut-out or the layers of one photo.

    Frames of a video, or of an image sequence with --sequence, are smoothed with the frames around them.
    """
    raise typer.Exit(work.run(inputs, batch, shots))
