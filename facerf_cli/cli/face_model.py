"""`facerf face-model`: fetch, import, list and show morphable face models."""

import logging
from pathlib import Path
from typing import Annotated, Literal

import typer

from facerf_cli.batch.inputs import refuse_read
from facerf_cli.cli.brief import Verbs
from facerf_cli.errors import UsageError
from facerf_cli.run.logs import LOGGER_NAME, json_line

_IMAGES = (".png", ".jpg", ".jpeg")
log = logging.getLogger(LOGGER_NAME)
app = typer.Typer(cls=Verbs, add_completion=False, help="Import, fetch, list and show morphable face models.")

Kind = Literal["ict-facekit", "flame", "basel-2009", "basel-2017", "basel-2019"]
Overwrite = Annotated[bool, typer.Option("--overwrite", help="Replace an existing file.")]


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
    overwrite: Overwrite = False,
) -> None:
    """Import a published morphable model as a file for --face-model.

    The mean and the shapes are resampled to facerf's UV layout, so that one checkpoint serves every model.
    The file keeps the model's licence. No code in FLAME's pickle is run.
    """
    if output.suffix != ".npz":
        raise UsageError(f"-o {output}: not a face model; give a file that ends in .npz")
    refuse_read([output], [path for path in (source, landmarks) if path])
    _refuse_existing(output, overwrite)
    from facerf_cli.face.model_files import import_to

    model = import_to(output, kind, source, landmarks)
    log.info(
        "%s: %d identity and %d expression shapes (%s)",
        model.name,
        len(model.identity),
        len(model.expression),
        model.licence,
    )
    print(output)


@app.command("fetch")
def fetch_model(
    kind: Annotated[Literal["ict-facekit"], typer.Argument(metavar="KIND", help="ict-facekit")],
) -> None:
    """Fetch a public morphable model into the cache, for `facerf face-model import`.

    A broken download continues where it stopped, and its content is verified. The other models come only from
    their authors, who require an agreement.
    """
    from facerf_cli.face.importers.ict import fetch_face_model

    path = fetch_face_model(kind)
    log.info("import it with: facerf face-model import %s %s -o %s.npz", kind, path, kind)
    print(path)


@app.command("list")
def list_models(
    as_json: Annotated[bool, typer.Option("--json", help="Print a JSON object a line instead.")] = False,
) -> None:
    """List the built-in face model, the imported ones in the working folder and those to fetch."""
    from facerf_cli.face.model_files import list_rows

    rows = list_rows()
    if as_json:
        for row in rows:
            print(json_line(row))
        return
    table = [[str(row[key]) for key in ("model", "name", "shapes", "licence")] for row in rows]
    widths = [max(len(line[column]) for line in table) for column in range(3)]
    for line in table:
        cells = [cell.ljust(width) for cell, width in zip(line, widths, strict=False)]
        print("  ".join([*cells, line[3]]).rstrip())


@app.command("show")
def show_model(
    model: Annotated[
        str, typer.Argument(metavar="MODEL", help="builtin, or a file of `face-model import`.")
    ] = "builtin",
    output: Annotated[
        Path | None,
        typer.Option(
            "--output", "-o", metavar="IMAGE", help="Draw the mean from eight sides: .png or .jpg.",
            show_default=False,
        ),
    ] = None,
    overwrite: Overwrite = False,
) -> None:  # fmt: skip
    """Show a face model's licence, unit, sizes, shapes and landmarks, and draw it with -o."""
    if output is not None and output.suffix.lower() not in _IMAGES:
        raise UsageError(f"-o {output}: not an image; give a file that ends in {', '.join(_IMAGES)}")
    if output is not None:
        refuse_read([output], [Path(model)])
        _refuse_existing(output, overwrite)
    from facerf_cli.face.model_files import show

    show(model, output)


def _refuse_existing(path: Path, overwrite: bool) -> None:
    """Raise UsageError for an existing file without --overwrite."""
    if path.exists() and not overwrite:
        raise UsageError(f"{path}: the file exists; give --overwrite to replace it")
