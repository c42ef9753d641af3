"""Source models: face models in their publishers' topology, before the canonical grid is laid on them."""

import zipfile
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from facerf_cli.errors import InputError
from facerf_cli.face.morphable import NPZ_ERRORS, check_npz_sizes
from facerf_cli.run.logs import one_line

EXPRESSION_STD = 0.3  # the share of a full blendshape that a coefficient of 1 means
_MAX_VERTICES, _MAX_TRIANGLES = 120_000, 240_000


@dataclass(frozen=True)
class SourceHead:
    """The part of a model's mesh that is its whole head.

    triangles [F, 3] of the source's vertex ids; part [N] uint8, an index into `HEAD_PARTS`; eyes: the vertex
    ids of each eyeball, a closed surface whose cornea points along the gaze.
    """

    triangles: np.ndarray
    part: np.ndarray
    eyes: tuple[np.ndarray, ...]


@dataclass(frozen=True)
class SourceModel:
    """A morphable model in its own topology: metres, y up, z out of the face; bases in standard deviations.

    mean [N, 3], identity [Ki, N, 3], expression [Ke, N, 3], triangles [F, 3] of the outer surface; known: the
    points on the mean of those of the 68 landmarks that the publisher names, by number.
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
    """Raise ValueError unless mean [N, 3] is finite and triangles [F, 3] name its vertices."""
    if mean.ndim != 2 or mean.shape[1] != 3 or not 100 <= len(mean) <= _MAX_VERTICES:
        raise ValueError(f"its mean has shape {list(mean.shape)}, not [N, 3]")
    if not np.isfinite(mean).all():
        raise ValueError("its mean holds values that are not finite")
    if triangles.ndim != 2 or triangles.shape[1] != 3 or not 1 <= len(triangles) <= _MAX_TRIANGLES:
        raise ValueError(f"its triangles have shape {list(triangles.shape)}, not [F, 3]")
    if triangles.min() < 0 or triangles.max() >= len(mean):
        raise ValueError("its triangles name vertices that it does not have")


def read_npz(path: Path) -> dict[str, np.ndarray]:
    """Read the arrays of an .npz by name, without pickles and with bounds, as `read_inert_pickle` does.

    Raises InputError for any other file.
    """
    try:
        if not zipfile.is_zipfile(path):
            raise ValueError("it is not an .npz")
        check_npz_sizes(path)
        with np.load(path, allow_pickle=False) as file:
            return {key: file[key] for key in file.files}
    except NPZ_ERRORS as error:
        raise InputError(
            f"{path}: cannot be read ({one_line(str(error))[:160]}); give an .npz of plain arrays"
        ) from None
