"""`facerf face-model`: morphable models that a user brings."""

import logging
from pathlib import Path
from typing import Annotated, Literal

import typer

from facerf_cli.errors import UsageError
from facerf_cli.files.atomic import atomic_path
from facerf_cli.records import LOGGER_NAME

log = logging.getLogger(LOGGER_NAME)
app = typer.Typer(help="Morphable face models.")


@app.callback()
def _group() -> None:
    pass


@app.command("import")
def import_model(
    kind: Annotated[Literal["ict-facekit"], typer.Argument(metavar="KIND", help="ict-facekit")],
    source: Annotated[
        Path,
        typer.Argument(metavar="PATH", help="The model as its authors publish it: folder, .zip or .tar."),
    ],
    output: Annotated[
        Path, typer.Option("--output", "-o", metavar="FILE.npz", help="For --face-model.", show_default=False)
    ],
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace a file that is there.")] = False,
) -> None:
    """Carry a morphable model to facerf's own mesh, once, for --face-model.

    Its mean and bases are resampled on the chart that all of facerf's textures share, so that one checkpoint
    serves every model. The model's licence goes with it.
    """
    from facerf_cli.face.importers.importing import import_face_model
    from facerf_cli.face.morphable import save_face_model

    if output.suffix != ".npz":
        raise UsageError(f"-o {output}: a face model is a file that ends in .npz")
    if output.exists() and not overwrite:
        raise UsageError(f"{output} is there already; give --overwrite to replace it")
    model = import_face_model(kind, source)
    with atomic_path(output) as temporary:
        save_face_model(temporary, model)
    log.info(
        "%s: %d identity and %d expression shapes (%s)",
        model.name,
        len(model.identity),
        len(model.expression),
        model.licence,
    )
    print(output)
