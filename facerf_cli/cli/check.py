"""`facerf check`: the outputs of a folder, read again and compared with its index."""

import logging
from collections import Counter
from pathlib import Path
from typing import Annotated

import typer

from facerf_cli.batch.made_from import check_outputs
from facerf_cli.batch.run import print_path
from facerf_cli.errors import UsageError
from facerf_cli.run.logs import LOGGER_NAME

log = logging.getLogger(LOGGER_NAME)


def check(
    folder: Annotated[
        Path, typer.Argument(metavar="DIR", help="Output folder of a verb.", show_default=False)
    ],
) -> None:
    """Read all outputs of a folder again, and list those that are not as they were written.

    Prints a line for each output that is missing, empty or changed; exits 1 if there is one. Changed files
    may be damaged, or edited by hand. Run the verb again to make missing and empty ones, and with
    --overwrite always the others.
    """
    counts: Counter[str] = Counter()
    for path, state in check_outputs(folder):
        counts[state] += 1
        if state != "whole":
            print_path(f"{path}: {state}")
    if not counts:
        raise UsageError(f"{folder}: no index of outputs; give the output folder of a verb that reads photos")
    log.info("%s", ", ".join(f"{count} {state}" for state, count in sorted(counts.items())))
    raise typer.Exit(int(counts["whole"] < counts.total()))
