"""`facerf prepare-dataset FOLDER --describe`: a first draft of stage.json, and what is left to a person."""

import logging
from pathlib import Path

import typer

from facerf_cli.commands.inputs import PHOTO_SUFFIXES
from facerf_cli.commands.options import refuse_given
from facerf_cli.errors import UsageError
from facerf_cli.records import LOGGER_NAME

_TAKEN = ("capture", "output", "describe", "dry_run")  # of the verb's arguments
log = logging.getLogger(LOGGER_NAME)


def describe_capture(context: typer.Context, folder: Path, output: Path | None, dry_run: bool) -> None:
    """Write the draft to FOLDER/stage.json, or where `output` says, never over anything; print its path.

    A dry run tells the same and writes nothing. UsageError for options that are for preparing.
    """
    from facerf_cli.files.atomic import atomic_path
    from facerf_cli.stage.data.stage_file import STAGE_FILE
    from facerf_cli.stage.draft.draft import as_text, draft_stage

    others = [name for name in context.params if name not in _TAKEN]
    refuse_given(context, others, "is for preparing; leave it out with --describe")
    path = folder / STAGE_FILE if output is None else output
    if path.is_dir():
        raise UsageError(f"-o {path}: is a folder; give the draft's name, such as {path / STAGE_FILE}")
    if path.exists() or path.is_symlink():
        raise UsageError(
            f"{path}: is there already, and a draft replaces nothing; move it, or give -o another name"
        )
    stage = draft_stage(folder, PHOTO_SUFFIXES)
    for note in stage["draft"]:
        log.info("%s", note)
    if dry_run:
        print(f"{folder} -> {path}")
        return
    with atomic_path(path) as temporary:
        temporary.write_text(as_text(stage), encoding="utf-8", errors="backslashreplace")
    print(path)
