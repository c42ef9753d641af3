"""`facerf face-model import`: import a published morphable face model."""

import logging
from pathlib import Path
from typing import Annotated

import typer

from facerf_cli.batch.inputs import refuse_read
from facerf_cli.cli.help import Verbs
from facerf_cli.errors import UsageError
from facerf_cli.run.logs import LOGGER_NAME

log = logging.getLogger(LOGGER_NAME)
app = typer.Typer(cls=Verbs, add_completion=False, help="Import morphable face models.")


@app.callback()
def _group() -> None:
    pass


@app.command("import")
def import_model(
    source: Annotated[
        Path,
        typer.Argument(
            metavar="FILE",
            help="Model as published: ICT-FaceKit's folder, .zip or .tar; FLAME's .pkl or .npz; Basel's .mat "
            "(2009) or .h5 (2017, 2019).",
        ),
    ],
    output: Annotated[
        Path,
        typer.Option(
            "--output", "-o", metavar="FILE.npz", help="File to write, for --face-model.", show_default=False
        ),
    ],
    landmarks: Annotated[
        Path | None,
        typer.Option(
            "--landmarks",
            metavar="FILE",
            help="FLAME's landmark embedding (.npy, .npz or .pkl).",
            show_default="landmark_embedding.npy beside the model",
        ),
    ] = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace an existing file.")] = False,
) -> None:
    """Import a published morphable model as a file for --face-model.

    The mean and the shapes are resampled to facerf's UV layout, so one checkpoint works with every model.
    The file keeps the model's licence. Code in FLAME's pickle is not executed.
    """
    if output.suffix != ".npz":
        raise UsageError(f"-o {output}: not a face model; use a file that ends in .npz")
    refuse_read([output], [path for path in (source, landmarks) if path])
    if output.exists() and not overwrite:
        raise UsageError(f"{output}: file exists; add --overwrite to replace it")
    from facerf_cli.face.importers.resample import import_face_model
    from facerf_cli.face.morphable import save_face_model
    from facerf_cli.files.atomic import atomic_path

    model = import_face_model(source, landmarks)
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
