"""`facerf view`: photos and OLAT stacks as web pages with movable lights."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import typer

from facerf_cli.batch.inputs import PHOTO_SUFFIXES, Item, collect_items
from facerf_cli.batch.journal import Journal
from facerf_cli.batch.run import sums_up
from facerf_cli.cli.options import InputsArgument
from facerf_cli.errors import InputError, UsageError
from facerf_cli.option import IMAGE, Without, option
from facerf_cli.work.photo_options import PhotoOptions, check_companion, networks_of
from facerf_cli.work.photo_work import FileOrFolder, PageWork, Written, ending_of_file

_PAGE, _INDEX = ".html", "index.html"


@dataclass(frozen=True, kw_only=True)
class MakePage(PageWork):
    """`facerf view`.

    Attributes:
        size_px: Longer side of the photo in the page.
    """

    photo: Annotated[PhotoOptions, Without("texture_side")]
    size_px: int = option(1024, metavar="PX", least=256, most=4096, panel=IMAGE, everyday=True)
    verb, endings, networks = "view", (_PAGE,), networks_of(["portrait"])
    file_endings = (_PAGE,)

    def write(self, item: Item) -> Written:
        """Write the page of every chosen face."""
        from facerf_cli.work.view import write_pages

        return write_pages(item, self)


def view(
    inputs: InputsArgument,
    work: MakePage,
    batch: Annotated[FileOrFolder, Without("name")],
) -> None:
    """Make a web page that relights a photo or an OLAT stack by moving lights.

    A folder of pages gets a list of them, index.html; -o me.html writes a single page. Each page is one file
    of about 5 MB that a browser opens without a server or network. It has single lights, rotated environment
    maps (.hdr and .exr can be dropped in), exposure, and the command that renders the same image.
    """
    photo, output = work.checked().photo, batch.output
    check_companion(work.normals_from, "--normals-from")
    items = collect_items(inputs, output, PHOTO_SUFFIXES, null_separated=photo.settings.null_separated)
    many = not ending_of_file(output, work.file_endings)
    if many and any(item.name == Path(_INDEX).stem for item in items):
        raise UsageError(f"{_INDEX}: reserved for the list of pages; rename the photo of that name")
    journal = Journal(output, work.verb)
    refusal = journal.refusal(output / _INDEX) if many and batch.overwrite != "always" else ""
    if refusal and batch.overwrite == "changed":
        raise InputError(refusal)
    code = work.run_on(items, batch)
    if many and not (refusal or batch.dry_run) and sums_up(items, work.outputs_of, batch):
        from facerf_cli.work.view import write_index

        write_index(output / _INDEX, items, photo)
        journal.add_file(output / _INDEX)
    raise typer.Exit(code)
