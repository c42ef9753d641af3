"""From a publisher's files to a face model on the canonical topology, by the kind of model."""

from pathlib import Path

import numpy as np

from facerf_cli.errors import InputError
from facerf_cli.face.importers.basel import read_basel_2009, read_basel_2017
from facerf_cli.face.importers.flame import read_flame
from facerf_cli.face.importers.ict import read_ict_facekit
from facerf_cli.face.importers.resample import resample_model
from facerf_cli.face.importers.source import SourceModel
from facerf_cli.face.morphable import MorphableModel
from facerf_cli.logs import one_line

_MAX_TEXT = 10_000


def import_face_model(kind: str, path: Path, landmarks: Path | None = None) -> MorphableModel:
    """The model in `path`, one of the kinds of `facerf face-model import`; what is wrong is an InputError.

    `landmarks` is an embedding for FLAME, or for any kind a .txt of 68 vertex numbers from 0 on.
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
        raise InputError(f"{landmarks}: for {kind}, give the landmarks as a .txt of 68 vertex numbers")
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
    """The points on a mean [N, 3] whose numbers a text file lists in the order of the 68."""
    try:
        numbers = [int(word) for word in path.read_text(encoding="utf-8")[:_MAX_TEXT].split()]
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: cannot be read ({one_line(str(error))})") from None
    if len(numbers) != 68 or not 0 <= min(numbers) <= max(numbers) < len(mean):
        raise InputError(f"{path}: holds {len(numbers)} numbers; 68 from 0 to {len(mean) - 1} are wanted")
    return dict(enumerate(mean[numbers]))
