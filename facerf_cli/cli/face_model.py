"""`facerf face-model import`: import a published morphable face model."""

import logging
from pathlib import Path
from typing import Annotated, Literal

import typer

from facerf_cli.batch.inputs import refuse_read
from facerf_cli.cli.brief import Verbs
from facerf_cli.errors import UsageError
from facerf_cli.run.logs import LOGGER_NAME

log = logging.getLogger(LOGGER_NAME)
app = typer.Typer(cls=Verbs, add_completion=False, help="Import morphable face models.")

Kind = Literal["ict-facekit", "flame", "basel-2009", "basel-2017", "basel-2019"]


@app.callback()
def _group() -> None:
    pass


@app.command("import")
def import_model(
    kind: Annotated[
        Kind, typer.Argument(metavar="KIND", help="ict-facekit, flame, basel-2009, basel-2017 or basel-2019.")
    ],
    source: Annotated[
        Path,
        typer.Argument(
            metavar="PATH",
            help="Model as published: ICT-FaceKit's folder, .zip or .tar; FLAME's .pkl or .npz; Basel's "
            "01_MorphableModel.mat (2009) or .h5 (2017, 2019).",
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
            help="Positions of the 68 landmarks: FLAME's landmark embedding (.npy, .npz, .pkl), or a .txt of "
            "68 vertex numbers from 0.",
            show_default="published landmarks, the others by the shape of the face",
        ),
    ] = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace an existing file.")] = False,
) -> None:
    """Import a published morphable model as a file for --face-model.

    The mean and the shapes are resampled to facerf's UV layout, so that one checkpoint serves every model.
    The file keeps the model's licence. No code in FLAME's pickle is run.
    """
    if output.suffix != ".npz":
        raise UsageError(f"-o {output}: not a face model; give a file that ends in .npz")
    refuse_read([output], [path for path in (source, landmarks) if path])
    if output.exists() and not overwrite:
        raise UsageError(f"{output}: the file exists; give --overwrite to replace it")
    from facerf_cli.face.importers.resample import import_face_model
    from facerf_cli.face.morphable import save_face_model
    from facerf_cli.files.atomic import atomic_path

    model = import_face_model(kind, source, landmarks)
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
