"""`facerf view`: photos and OLAT stacks as pages in which lights are moved by hand."""

from pathlib import Path
from typing import Annotated

import typer

from facerf_cli.batch.run import BatchOptions
from facerf_cli.cli.options import InputsArgument
from facerf_cli.option import Without
from facerf_cli.work.verbs import MakePage


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
    raise typer.Exit(work.run(inputs, output, batch))
