"""`facerf relight`: photos, or OLAT stacks, under environment maps and single lights."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

import typer

from facerf_cli.batch.inputs import Item
from facerf_cli.batch.run import BatchOptions, Outcome
from facerf_cli.cli.options import FramesArgument, is_default, refuse_given
from facerf_cli.option import Without
from facerf_cli.work.light_setups import LightSources
from facerf_cli.work.output_options import NEEDS, STDOUT, format_of_file
from facerf_cli.work.relight_options import Relight
from facerf_cli.work.shots import ShotOptions, film_output


@dataclass(frozen=True)
class RelightItem(Relight):
    """Relights one item under every light setup."""

    def __call__(self, item: Item) -> Outcome:
        """Relight an item."""
        from facerf_cli.work.relight import relight_item

        return relight_item(item, self.for_stale(item))


def relight(
    context: typer.Context,
    inputs: FramesArgument,
    output: Annotated[
        Path,
        typer.Option(
            "--output",
            "-o",
            metavar="DIR|FILE",
            help="Write the results to this folder; one image to this file (.exr, .png, .jpg, .tif); or one "
            "film as .mp4 (H.264) or .mov (ProRes).",
            show_default=False,
        ),
    ],
    sources: LightSources,
    work: RelightItem,
    shots: ShotOptions,
    batch: Annotated[BatchOptions, Without("output", "name")],
) -> None:
    """Relight photos, or OLAT stacks, under environment maps and single lights.

    Each image is a scene-linear EXR with the matte as layer person.A, and a PNG at --exposure.
    A background that keeps its look has its own values in the EXR at --exposure 0, else those over 2^EV.
    A film, or images with --sequence, is one shot between cuts: one identity, and one light by which the
    field is corrected; frames steady each other's pose, expression and matte. -o FILE.mp4 or
    FILE.mov joins frames to a film, with the sound of the film that they come from.

    -o - writes one image to standard output. A stack is relit by its own lights: --lights does not apply, and
    --light between them is a sum of the three around it.
    """
    file, formats = format_of_file(output), work.output.formats
    film = None if file else film_output(output, work.fps)
    if file is not None:
        formats = (file,) if is_default(context, "formats") else formats
        refuse_given(context, ("ball", "name", "fps"), f"is not for -o {output}, one image; leave it out")
        work, output = work.into_file(output, file, formats), output.parent
    elif film is not None:
        refuse_given(context, ("formats", "ball", "name"), f"is not for -o {output}; leave it out")
        formats, output = film.formats, film.folder
    elif output == STDOUT:
        refuse_given(context, ("ball", "dry_run"), "is not for -o -, which writes one image; leave it out")
        if is_default(context, "formats"):
            formats = ("png",)
    for name, needed in NEEDS.items():
        if not set(needed) & set(formats):
            refuse_given(context, (name,), f"is for {', '.join(needed)}; add that to --format")
    work = replace(work, output=replace(work.output, formats=formats))
    batch = replace(batch, output=output, name=work.name)
    raise typer.Exit(work.run(inputs, sources, shots, batch, film))
