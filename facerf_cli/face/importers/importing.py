"""From a publisher's files to a face model on the canonical topology, by the kind of model."""

from pathlib import Path

from facerf_cli.errors import InputError
from facerf_cli.face.importers.carry import carry_over
from facerf_cli.face.importers.ict import read_ict_facekit
from facerf_cli.face.morphable import MorphableModel


def import_face_model(kind: str, path: Path) -> MorphableModel:
    """The model in `path`, one of the kinds of `facerf face-model import`; what is wrong is an InputError."""
    source = read_ict_facekit(path)
    try:
        return carry_over(source)
    except InputError as error:
        raise InputError(f"{path}: {error}") from None
