"""What a face model's file says of itself, without reading its shapes."""

import zipfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from facerf_cli.errors import InputError
from facerf_cli.face.morphable import DAMAGED, require_bounded, words_of


@dataclass(frozen=True)
class ModelFacts:
    """A face model's name, its licence, and how many shapes it has of each kind."""

    name: str
    licence: str
    identities: int
    expressions: int
    has_head: bool


def read_model_facts(path: Path) -> ModelFacts | None:
    """The facts of a file that `facerf face-model import` wrote; None for any other .npz."""
    try:
        if not zipfile.is_zipfile(path):
            return None
        require_bounded(path)
        with np.load(path, allow_pickle=False) as file:
            if not {"layout_version", "name", "licence", "identity", "expression"} <= set(file.files):
                return None
            name, licence = (words_of(file[key]) for key in ("name", "licence"))
            has_head = "head_mean" in file.files
        return ModelFacts(name, licence, _count(path, "identity"), _count(path, "expression"), has_head)
    except (*DAMAGED, InputError):
        return None


def _count(path: Path, key: str) -> int:
    """The first length of an array, from its header alone."""
    with zipfile.ZipFile(path) as archive, archive.open(f"{key}.npy") as file:
        np.lib.format.read_magic(file)
        shape, _, _ = np.lib.format.read_array_header_1_0(file)
    return int(shape[0])
