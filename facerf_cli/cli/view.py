"""`facerf view`: photos and OLAT stacks as pages in which lights are moved by hand."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

import typer

from facerf_cli.batch.inputs import PHOTO_SUFFIXES, Item, collect_items
from facerf_cli.batch.run import BatchOptions, sums_up
from facerf_cli.cli.options import InputsArgument
from facerf_cli.errors import UsageError
from facerf_cli.option import IMAGE, Without, option
from facerf_cli.work.photo_options import PhotoOptions, networks_of
from facerf_cli.work.verbs import PhotoWork, Written

_PAGE, _INDEX = ".html", "index.html"


@dataclass(frozen=True, kw_only=True)
class MakePage(PhotoWork):
    """`facerf view`.

    Attributes:
        size_px: Show photos with so many pixels along the longer side.
    """

    photo: Annotated[PhotoOptions, Without("texture_side")]
    size_px: int = option(1024, metavar="PX", least=256, most=4096, panel=IMAGE)
    verb, endings, networks = "view", (_PAGE,), networks_of(["portrait"])

    def write(self, item: Item) -> Written:
        """Write the page of every chosen face."""
        from facerf_cli.work.view_photos import write_pages

        return write_pages(item, self.photo, self.size_px)


def view(
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
    work: MakePage,
    batch: Annotated[BatchOptions, Without("output", "name")],
) -> None:
    """Make a web page in which a photo, or an OLAT stack, is relit by moving lights.

    One file of about 4 MB, which a browser opens without a server or a network: single lights, rotated
    environment maps (.hdr and .exr can be dropped in), exposure, and the command that makes the same image.
    """
    photo, is_one = work.checked().photo, output.suffix.lower() == _PAGE
    batch = replace(batch, output=output.parent if is_one else output)
    items = collect_items(inputs, batch.output, PHOTO_SUFFIXES, null_separated=photo.settings.null_separated)
    if is_one:
        if len(items) > 1 or photo.face == "all":
            raise UsageError(f"-o {output}: is one page; give one photo and one face, or a folder")
        items = [replace(items[0], output_base=output.with_suffix(""), name=output.stem)]
    elif any(item.name == Path(_INDEX).stem for item in items):
        raise UsageError(f"{_INDEX}: is the list of all pages; rename the photo of that name")
    code = work.run_on(items, batch)
    if not is_one and not batch.dry_run and sums_up(items, work.outputs_of, batch):
        from facerf_cli.work.view_photos import write_index

        write_index(output / _INDEX, items, photo)
    raise typer.Exit(code)
