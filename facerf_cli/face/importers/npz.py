"""Arrays of other people's .npz files, without pickles and with bounds."""

import zipfile
from pathlib import Path

import numpy as np

from facerf_cli.errors import InputError
from facerf_cli.face.morphable import DAMAGED, require_bounded
from facerf_cli.files.inert_arrays import InertArray
from facerf_cli.records import one_line


def read_npz(path: Path) -> dict[str, InertArray]:
    """Every array of an .npz by its name, as an inert pickle gives them; an InputError for what is none."""
    try:
        if not zipfile.is_zipfile(path):
            raise ValueError("it is no .npz")
        require_bounded(path)
        with np.load(path, allow_pickle=False) as file:
            return {key: InertArray(file[key]) for key in file.files}
    except DAMAGED as error:
        raise InputError(
            f"{path}: cannot be read ({one_line(str(error))[:160]}); an .npz of plain arrays is wanted"
        ) from None
