"""`facerf view`: photos and OLAT stacks as pages in which lights are moved by hand."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

import typer

from facerf_cli.batch.inputs import PHOTO_SUFFIXES, Item, collect_items
from facerf_cli.batch.made_from import OneRecipe
from facerf_cli.batch.run import BatchOptions, Outcome, run_items, sums_up
from facerf_cli.cli.options import (
    IMAGE,
    DryRunOption,
    FaceModelOption,
    InputColourspaceOption,
    InputsArgument,
    JobsOption,
    OverwriteOption,
    settings_of,
)
from facerf_cli.cli.photo_options import (
    FaceOption,
    GeometryOption,
    LandmarksFromOption,
    LandmarksOption,
    PhotoOptions,
    networks_of,
)
from facerf_cli.errors import UsageError

_PAGE, _INDEX = ".html", "index.html"


@dataclass(frozen=True)
class MakePage:
    """Make the page of one photo or stack; settings only."""

    photo: PhotoOptions
    size_px: int

    def outputs_of(self, item: Item) -> list[Path]:
        """The page of an item's (first) face."""
        return [item.output(self.photo.first_tag + _PAGE)]

    def __call__(self, item: Item) -> Outcome:
        """Write the page of every chosen face."""
        from facerf_cli.work.view_photos import write_pages

        paths, facts = write_pages(item, self)
        return Outcome(paths, facts)


def view(
    context: typer.Context,
    inputs: InputsArgument,
    output: Annotated[
        Path,
        typer.Option(
            "--output",
            "-o",
            metavar="FILE.html|DIR",
            help="Write the page of one photo to this file; or pages and index.html to this folder.",
            show_default=False,
        ),
    ],
    size: Annotated[
        int,
        typer.Option(
            min=256,
            max=4096,
            metavar="PX",
            help="Show photos with so many pixels along the longer side.",
            rich_help_panel=IMAGE,
        ),
    ] = 1024,
    face: FaceOption = "largest",
    landmarks: LandmarksOption = None,
    geometry: GeometryOption = None,
    landmarks_from: LandmarksFromOption = "facerf",
    input_colourspace: InputColourspaceOption = None,
    face_model: FaceModelOption = "builtin",
    overwrite: OverwriteOption = "changed",
    dry_run: DryRunOption = False,
    jobs: JobsOption = 1,
) -> None:
    """Make a web page in which a photo, or an OLAT stack, is relit by moving lights.

    One file of about 4 MB, which a browser opens without a server or a network: single lights, rotated
    environment maps (.hdr and .exr can be dropped in), exposure, and the command that makes the same image.
    """
    photo = PhotoOptions(
        settings_of(context),
        input_colourspace,
        face_model,
        face,
        landmarks,
        geometry,
        landmarks_from=landmarks_from,
    )
    photo.check()
    work = MakePage(photo, size)
    one = output.suffix.lower() == _PAGE
    folder = output.parent if one else output
    items = collect_items(inputs, folder, PHOTO_SUFFIXES, null_separated=photo.settings.null_separated)
    if one:
        if len(items) > 1 or face == "all":
            raise UsageError(f"-o {output}: is one page; give one photo and one face, or a folder")
        items = [replace(items[0], output_base=output.with_suffix(""), name=output.stem)]
    elif any(item.name == Path(_INDEX).stem for item in items):
        raise UsageError(f"{_INDEX}: is the list of all pages; rename the photo of that name")
    options = BatchOptions(folder, overwrite, dry_run, jobs)
    prepare = photo.preparation(dry_run, networks_of(["portrait"]))
    code = run_items("view", items, work, work.outputs_of, options, photo.settings, OneRecipe(work), prepare)
    if not one and not dry_run and sums_up(items, work.outputs_of, options, photo.settings):
        from facerf_cli.work.view_photos import write_index

        write_index(folder / _INDEX, items, work)
    raise typer.Exit(code)
