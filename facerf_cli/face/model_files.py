"""Face models imported, listed, described and drawn for `facerf face-model`."""

import logging
from contextlib import suppress
from pathlib import Path
from typing import Any

from facerf_cli.errors import InputError
from facerf_cli.face.importers.ict import PUBLISHED, cached_face_model
from facerf_cli.face.importers.resample import import_face_model
from facerf_cli.face.morphable import (
    BUILTIN,
    BUILTIN_PATH,
    MorphableModel,
    load_face_model,
    save_face_model,
)
from facerf_cli.face.topology import GRID, OUTER_EYE_CORNERS, grid_triangles
from facerf_cli.face.view import draw_turntable
from facerf_cli.files.atomic import atomic_path
from facerf_cli.files.write import write_display
from facerf_cli.run.logs import COMPUTER_GRAPHICS_SOURCE_TYPE, LOGGER_NAME, Provenance

_NAMES_SHOWN = 12
log = logging.getLogger(LOGGER_NAME)


def import_to(output: Path, kind: str, source: Path, landmarks: Path | None) -> MorphableModel:
    """Import a published model and write it to `output`."""
    model = import_face_model(kind, source, landmarks)
    with atomic_path(output) as temporary:
        save_face_model(temporary, model)
    return model


def list_rows() -> list[dict[str, Any]]:
    """Rows of the list: models by their value for --face-model, then published archives for `import`."""
    rows: list[dict[str, Any]] = []
    files = [(BUILTIN, BUILTIN_PATH), *((str(path), path) for path in sorted(Path().glob("*.npz")))]
    for model, path in files:
        with suppress(InputError):
            found = load_face_model(path)
            shapes = f"{len(found.identity)} + {len(found.expression)}"
            rows.append({"model": model, "name": found.name, "shapes": shapes, "licence": found.licence})
    for kind in PUBLISHED:
        cached = cached_face_model(kind)
        words = f"to import: {cached}" if cached else f"not here; facerf face-model fetch {kind}"
        rows.append({"model": "-", "name": kind, "shapes": "-", "licence": words, "archive": cached})
    return rows


def show(name: str, output: Path | None) -> None:
    """Print the facts of a face model, and draw it to `output`."""
    model = load_face_model(name)
    for fact, value in _facts(model).items():
        print(f"{fact:<12}{value}")
    if output is not None:
        made = Provenance(Path(name).name, **model.stamp, source_type=COMPUTER_GRAPHICS_SOURCE_TYPE)
        write_display(output, draw_turntable(model), 0.0, metadata=made.attributes())
        log.info("%s: drawn", output)


def _facts(model: MorphableModel) -> dict[str, str]:
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
