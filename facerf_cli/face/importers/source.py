"""Arrays of other people's .npz files, without pickles and with bounds.

What an importer makes of a publisher's files, before it is carried to the canonical topology.
"""

import zipfile
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from facerf_cli.errors import InputError
from facerf_cli.face.morphable import DAMAGED, require_bounded
from facerf_cli.files.inert_arrays import InertArray
from facerf_cli.logs import one_line


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


EXPRESSION_STD = 0.3  # of a full blendshape: the spread that a coefficient of 1 stands for
_MAX_VERTICES, _MAX_TRIANGLES = 120_000, 240_000


@dataclass(frozen=True)
class SourceHead:
    """What of a model's own mesh makes its whole head.

    triangles [F, 3] in the source's vertex ids; part [N] uint8 into `HEAD_PARTS`; eyes: the vertex ids of
    each ball, a closed surface whose cornea looks along the gaze.
    """

    triangles: np.ndarray
    part: np.ndarray
    eyes: tuple[np.ndarray, ...]


@dataclass(frozen=True)
class SourceModel:
    """A morphable model in its own topology: metres, y up, z out of the face; bases in standard deviations.

    mean [N, 3], identity [Ki, N, 3], expression [Ke, N, 3], triangles [F, 3] of the outer surface; known:
    where those of the 68 landmarks that the publisher names lie on the mean, by number.
    """

    name: str
    licence: str
    mean: np.ndarray
    identity: np.ndarray
    expression: np.ndarray
    expression_names: tuple[str, ...]
    triangles: np.ndarray
    known: dict[int, np.ndarray] = field(default_factory=dict)
    head: SourceHead | None = None


def require_mesh(mean: np.ndarray, triangles: np.ndarray) -> None:
    """A ValueError unless these are a mesh: mean [N, 3], finite, and triangles [F, 3] of its vertices."""
    if mean.ndim != 2 or mean.shape[1] != 3 or not 100 <= len(mean) <= _MAX_VERTICES:
        raise ValueError(f"its mean has shape {list(mean.shape)}, not [N, 3]")
    if not np.isfinite(mean).all():
        raise ValueError("its mean holds values that are not finite")
    if triangles.ndim != 2 or triangles.shape[1] != 3 or not 1 <= len(triangles) <= _MAX_TRIANGLES:
        raise ValueError(f"its triangles have shape {list(triangles.shape)}, not [F, 3]")
    if triangles.min() < 0 or triangles.max() >= len(mean):
        raise ValueError("its triangles name vertices that it does not have")
