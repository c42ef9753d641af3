"""Where FLAME's landmarks lie on its mesh: the embeddings that travel with it, in the forms they have.

An embedding is a triangle and barycentric weights a point: `landmark_embedding.npy` (DECA: a pickled table
with all 68 as `full_lmk_faces_idx` and `full_lmk_bary_coords`, the 51 inner ones as `static_...`), or
`lmk_face_idx` and `lmk_b_coords` of 51 or 68 points (FLAME's `flame_static_embedding.pkl`, and .npz files).
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from facerf_cli.errors import InputError
from facerf_cli.face.importers.npz import read_npz
from facerf_cli.files.inert_arrays import array_of
from facerf_cli.files.inert_pickle import read_inert_pickle, read_inert_stream
from facerf_cli.records import one_line

_KEYS = (
    ("full_lmk_faces_idx", "full_lmk_bary_coords"),
    ("lmk_face_idx", "lmk_b_coords"),
    ("static_lmk_faces_idx", "static_lmk_bary_coords"),
)
_INNER = 51  # landmarks without the contour, which are the last of the 68


def read_embedding(path: Path, mean: np.ndarray, triangles: np.ndarray) -> dict[int, np.ndarray]:
    """Points on the mean [N, 3] by their number among the 68; an InputError where the file has none."""
    try:
        table = _table(path)
        faces, weights = next(
            (array_of(table[first]), array_of(table[second]))
            for first, second in _KEYS
            if first in table and second in table
        )
        faces, weights = faces.astype(np.int64).ravel(), weights.astype(np.float64).reshape(-1, 3)
        if len(faces) not in (_INNER, 68) or len(weights) != len(faces):
            raise ValueError(f"it has {len(faces)} points and {len(weights)} weights")
        if not (0 <= faces.min() <= faces.max() < len(triangles)) or abs(weights.sum(-1) - 1).max() > 0.01:
            raise ValueError("it is of another mesh")
    except StopIteration:
        keys = ", ".join(key for pair in _KEYS for key in pair)
        raise InputError(f"{path}: no embedding of FLAME's landmarks in it (none of {keys})") from None
    except (ValueError, KeyError, TypeError, OSError, EOFError) as error:
        raise InputError(
            f"{path}: not an embedding of FLAME's landmarks ({one_line(str(error))[:160]})"
        ) from None
    points = np.einsum("nkc,nk->nc", mean[triangles[faces]], weights)
    return dict(zip(range(68 - len(points), 68), points, strict=True))


def _table(path: Path) -> Mapping[str, Any]:
    if not path.is_file():
        raise InputError(f"{path}: no such file")
    if path.suffix == ".npz":
        return read_npz(path)
    if path.suffix != ".npy":
        table = read_inert_pickle(path)
    else:
        with path.open("rb") as file:
            if np.lib.format.read_magic(file) != (1, 0):
                raise ValueError("a newer .npy than embeddings come in")
            _, _, kind = np.lib.format.read_array_header_1_0(file)
            if not kind.hasobject:
                raise ValueError("it holds plain numbers, not a table")
            table = read_inert_stream(file, path)
    if not isinstance(table, dict):
        raise ValueError(f"it holds a {type(table).__name__}, not a table")
    return table
