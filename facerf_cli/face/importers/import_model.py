"""Import of a published face model to the canonical topology, by its kind."""

from pathlib import Path

import numpy as np

from facerf_cli.errors import InputError
from facerf_cli.face.importers.basel import read_basel_2009, read_basel_2017
from facerf_cli.face.importers.flame import read_flame
from facerf_cli.face.importers.ict import read_ict_facekit
from facerf_cli.face.importers.resample import resample_model
from facerf_cli.face.importers.source import SourceModel
from facerf_cli.face.morphable import MorphableModel
from facerf_cli.files.texts import require_regular
from facerf_cli.run.logs import one_line

_MAX_LETTERS = 10_000  # of a list of vertex numbers


def import_face_model(kind: str, path: Path, landmarks: Path | None = None) -> MorphableModel:
    """Import the model in `path`, of one of the kinds of `facerf face-model import`.

    `landmarks` is an embedding for FLAME, or for any kind a .txt of 68 vertex numbers from 0. Raises
    InputError for files that cannot be imported.
    """
    source = _read(kind, path, landmarks)
    try:
        return resample_model(source)
    except InputError as error:
        raise InputError(f"{path}: {error}") from None


def _read(kind: str, path: Path, landmarks: Path | None) -> SourceModel:
    listed = landmarks is not None and landmarks.suffix == ".txt"
    if kind == "flame":
        source = read_flame(path, None if listed else landmarks)
    elif landmarks is not None and not listed:
        raise InputError(f"{landmarks}: not for {kind}; give the landmarks as a .txt of 68 vertex numbers")
    elif kind == "basel-2009":
        source = read_basel_2009(path)
    elif kind in ("basel-2017", "basel-2019"):
        source = read_basel_2017(path, kind)
    else:
        source = read_ict_facekit(path)
    if landmarks is not None and listed:
        source.known.update(_listed(landmarks, source.mean))
    return source


def _listed(path: Path, mean: np.ndarray) -> dict[int, np.ndarray]:
    """The landmarks on a mean [N, 3] by number, from a text file of 68 vertex numbers."""
    require_regular(path, "give a .txt of 68 vertex numbers")
    try:
        numbers = [int(word) for word in path.read_text(encoding="utf-8")[:_MAX_LETTERS].split()]
    except (OSError, ValueError) as error:
        raise InputError(
            f"{path}: cannot be read ({one_line(str(error))}); give a .txt of 68 vertex numbers"
        ) from None
    if len(numbers) != 68 or not 0 <= min(numbers) <= max(numbers) < len(mean):
        raise InputError(f"{path}: holds {len(numbers)} numbers; give 68 from 0 to {len(mean) - 1}")
    return dict(enumerate(mean[numbers]))
