"""`facerf face-model`: morphable models that a user brings, or has fetched."""

import logging
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from facerf_cli.errors import UsageError
from facerf_cli.files.atomic import atomic_path
from facerf_cli.logs import COMPUTER_GRAPHICS_SOURCE_TYPE, LOGGER_NAME, Provenance, json_line

if TYPE_CHECKING:
    from facerf_cli.face.morphable import MorphableModel

_IMAGES = (".png", ".jpg", ".jpeg")
_NAMES_SHOWN = 12
log = logging.getLogger(LOGGER_NAME)
app = typer.Typer(help="Morphable face models.")

Kind = Literal["ict-facekit", "flame", "basel-2009", "basel-2017", "basel-2019"]


@app.callback()
def _group() -> None:
    pass


@app.command("import")
def import_model(
    kind: Annotated[
        Kind,
        typer.Argument(metavar="KIND", help="ict-facekit, flame, basel-2009, basel-2017 or basel-2019."),
    ],
    source: Annotated[
        Path,
        typer.Argument(
            metavar="PATH",
            help="The model as its authors publish it: ICT-FaceKit's folder, .zip or .tar; FLAME's .pkl or "
            ".npz; Basel's 01_MorphableModel.mat (2009) or .h5 (2017, 2019).",
        ),
    ],
    output: Annotated[
        Path, typer.Option("--output", "-o", metavar="FILE.npz", help="For --face-model.", show_default=False)
    ],
    landmarks: Annotated[
        Path | None,
        typer.Option(
            "--landmarks",
            metavar="FILE",
            help="Where the 68 points lie: FLAME's landmark embedding (.npy, .npz, .pkl), or a .txt of 68 "
            "vertex numbers from 0 on.",
            show_default="those that are published, the others by the face's shape",
        ),
    ] = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace a file that is there.")] = False,
) -> None:
    """Carry a morphable model to facerf's own mesh, once, for --face-model.

    Its mean and bases are resampled on the chart that all of facerf's textures share, so that one checkpoint
    serves every model. The model's licence goes with it. Of FLAME's pickle nothing is run.
    """
    from facerf_cli.face.importers.import_model import import_face_model
    from facerf_cli.face.morphable import save_face_model

    if output.suffix != ".npz":
        raise UsageError(f"-o {output}: a face model is a file that ends in .npz")
    if output.exists() and not overwrite:
        raise UsageError(f"{output} is there already; give --overwrite to replace it")
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


@app.command("fetch")
def fetch_model(
    kind: Annotated[Literal["ict-facekit"], typer.Argument(metavar="KIND", help="ict-facekit")],
) -> None:
    """Fetch a public morphable model into the cache, for `facerf face-model import`.

    A broken connection is taken up again where it broke; what came is verified. The other models are to be
    had from their authors alone, who ask for an agreement.
    """
    from facerf_cli.face.importers.ict import fetch_face_model

    path = fetch_face_model(kind)
    log.info("import it with: facerf face-model import %s %s -o %s.npz", kind, path, kind)
    print(path)


@app.command("list")
def list_models(
    as_json: Annotated[bool, typer.Option("--json", help="Print a JSON object a line instead.")] = False,
) -> None:
    """List the face models that are here: built in, in the cache, and imported in the working folder."""
    rows = _rows()
    if as_json:
        for row in rows:
            print(json_line(row))
        return
    table = [[str(row[key]) for key in ("model", "name", "shapes", "licence")] for row in rows]
    widths = [max(len(line[column]) for line in table) for column in range(3)]
    for line in table:
        cells = [cell.ljust(width) for cell, width in zip(line, widths, strict=False)]
        print("  ".join([*cells, line[3]]).rstrip())


def _rows() -> list[dict[str, Any]]:
    """What is listed: models by what --face-model takes for them, then archives that `import` takes."""
    from facerf_cli.face.importers.ict import PUBLISHED, cached_face_model
    from facerf_cli.face.morphable import BUILTIN, BUILTIN_PATH, read_model_facts

    rows: list[dict[str, Any]] = []
    files = [(BUILTIN, BUILTIN_PATH), *((str(path), path) for path in sorted(Path().glob("*.npz")))]
    for model, path in files:
        if facts := read_model_facts(path):
            shapes = f"{facts.identities} + {facts.expressions}"
            rows.append({"model": model, "name": facts.name, "shapes": shapes, "licence": facts.licence})
    for kind in PUBLISHED:
        cached = cached_face_model(kind)
        words = f"to import: {cached}" if cached else f"not here; facerf face-model fetch {kind}"
        rows.append({"model": "-", "name": kind, "shapes": "-", "licence": words, "archive": cached})
    return rows


@app.command("show")
def show_model(
    model: Annotated[
        str, typer.Argument(metavar="MODEL", help="builtin, or a file that `face-model import` wrote.")
    ] = "builtin",
    output: Annotated[
        Path | None,
        typer.Option(
            "--output", "-o", metavar="PICTURE", help="Draw its mean from eight sides: .png or .jpg.",
            show_default=False,
        ),
    ] = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace a file that is there.")] = False,
) -> None:  # fmt: skip
    """Say what a face model is: its licence, unit, sizes, shapes and landmarks; and draw it."""
    from facerf_cli.face.morphable import load_face_model

    if output is not None and output.suffix.lower() not in _IMAGES:
        raise UsageError(f"-o {output}: give a picture that ends in {', '.join(_IMAGES)}")
    if output is not None and output.exists() and not overwrite:
        raise UsageError(f"{output} is there already; give --overwrite to replace it")
    loaded = load_face_model(model)
    for name, value in _facts(loaded).items():
        print(f"{name:<12}{value}")
    if output is not None:
        _draw(loaded, model, output)


def _facts(model: "MorphableModel") -> dict[str, str]:
    from facerf_cli.face.topology import GRID, OUTER_EYE_CORNERS, grid_triangles

    width, height, depth = (1000 * (model.mean.amax(0) - model.mean.amin(0))).tolist()
    landmarks = model.landmarks(model.mean[None])[0]
    eyes_mm = 1000 * float((landmarks[OUTER_EYE_CORNERS[0]] - landmarks[OUTER_EYE_CORNERS[1]]).norm())
    names = model.expression_names
    more = f" and {len(names) - _NAMES_SHOWN} more" if len(names) > _NAMES_SHOWN else ""
    head = model.head
    return {
        "name": model.name,
        "licence": model.licence,
        "unit": "metres; a coefficient of 1 is one standard deviation",
        "face": f"{len(model.mean)} vertices ({GRID} x {GRID}), {len(grid_triangles())} triangles; "
        f"{width:.0f} x {height:.0f} x {depth:.0f} mm",
        "head": f"{len(head.mean)} vertices, {len(head.triangles)} triangles" if head else "none",
        "identity": f"{len(model.identity)} shapes; the largest moves a vertex by up to "
        f"{1000 * float(model.identity.norm(dim=-1).max()):.1f} mm",
        "expression": f"{len(names)} shapes: {', '.join(names[:_NAMES_SHOWN])}{more}",
        "landmarks": f"68; the eyes' outer corners are {eyes_mm:.1f} mm apart",
    }


def _draw(model: "MorphableModel", name: str, output: Path) -> None:
    from facerf_cli.face.drawings import draw_turntable
    from facerf_cli.files.images import write_display

    made = Provenance(Path(name).name, **model.stamp, source_type=COMPUTER_GRAPHICS_SOURCE_TYPE)
    write_display(output, draw_turntable(model), 0.0, metadata=made.attributes())
    log.info("%s: drawn", output)
