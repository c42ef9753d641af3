"""Importer of FLAME (Li et al., 'Learning a model of facial shape and expression from 4D scans', 2017).

Files of 2019 to 2023 contain `v_template` [5023, 3] in metres, `f` [9976, 3], and `shapedirs` [5023, 3, 400]:
300 identity and 100 expression shapes, scaled by their standard deviations (like smplx and DECA read them).
FLAME opens the mouth by rotating the jaw, which is not a shape; `posedirs`, `weights` and `J_regressor` are
converted to three jaw shapes. In `flame2023_no_jaw.pkl`, expressions open the mouth and the jaw is fixed.

An embedding defines the 68 landmarks by triangles and barycentric weights. Its file is
`landmark_embedding.npy` (DECA: a pickled table with `full_lmk_faces_idx` and `full_lmk_bary_coords`), or an
.npz or .pkl with `lmk_face_idx` and `lmk_b_coords`.
"""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from facerf_cli.face.importers.source import SourceModel, numbers, refusal
from facerf_cli.face.morphable import read_npz
from facerf_cli.files.inert_pickle import pickled_arrays
from facerf_cli.files.sandbox import read_in_subprocess
from facerf_cli.files.texts import require_regular

IDENTITIES = 300  # number of identity shapes, which precede the expressions
_LICENCE = (
    "FLAME, (c) Max-Planck-Gesellschaft; under the licence that its download came with "
    "(flame.is.tue.mpg.de; non-commercial research, unless that says otherwise)"
)
_OPEN_LICENCE = "FLAME 2023 Open, (c) Max-Planck-Gesellschaft; CC BY 4.0 (flame.is.tue.mpg.de)"
_OPEN_KEY = "supr_expression_metadata"  # identifies FLAME 2023 Open
_NO_JAW = "no_jaw"  # in a file's name, because the content does not tell
_JAW, _JOINTS = 2, 5  # joints: root, neck, jaw and two eyes
_JAW_STD_RAD = 0.1  # a coefficient of 3 opens the mouth by 17 degrees
_JAW_SHAPES = {  # rotation vectors of the jaw in units of _JAW_STD_RAD
    "jaw_open": (1, 0, 0),
    "jaw_turn": (0, 0.3, 0),
    "jaw_roll": (0, 0, 0.3),
}


def read_flame(path: Path, landmarks: Path | None = None) -> SourceModel:
    """Read FLAME from its .pkl, or from an .npz of the same arrays; raises InputError for any other file.

    `landmarks` is an embedding; the default is `landmark_embedding.npy` in the model's folder.
    """
    require_regular(path, "use FLAME's .pkl, or an .npz of the same arrays")
    with refusal(path, "a FLAME model"):
        raw = _table(path)
        mean = numbers(raw, "v_template", (None, 3)).astype(np.float64)
        bases = np.moveaxis(numbers(raw, "shapedirs", (len(mean), 3, None)), -1, 0).astype(np.float32)
        jaw = {} if _NO_JAW in path.stem else _jaw_shapes(mean, raw)
        names = tuple(f"expression_{index:03d}" for index in range(len(bases[IDENTITIES:])))
        source = SourceModel(
            name="flame",
            licence=_OPEN_LICENCE if _OPEN_KEY in raw else _LICENCE,
            mean=mean,
            identity=bases[:IDENTITIES],
            expression=np.concatenate([bases[IDENTITIES:], *jaw.values()]),
            expression_names=names + tuple(jaw),
            triangles=numbers(raw, "f", (None, 3)).astype(np.int64),
        )
    embedding = landmarks or path.with_name("landmark_embedding.npy")
    source.known.update(read_embedding(embedding, source.mean, source.triangles))
    return source


def _table(path: Path) -> dict[str, np.ndarray]:
    return read_npz(path) if path.suffix == ".npz" else read_in_subprocess(pickled_arrays, path)


def _jaw_shapes(mean: np.ndarray, raw: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Compute jaw shapes of one standard deviation [1, N, 3] (linear blend skinning, FLAME's equation 2).

    A file without a skeleton has none. Raises ValueError for a skeleton that is not FLAME's.
    """
    if not raw.keys() >= {"posedirs", "weights", "J_regressor"}:
        return {}
    corrections = numbers(raw, "posedirs", (len(mean), 3, 9 * (_JOINTS - 1))).astype(np.float64)
    weight = numbers(raw, "weights", (len(mean), _JOINTS)).astype(np.float64)[:, _JAW, None]
    joint = numbers(raw, "J_regressor", (_JOINTS, len(mean))).astype(np.float64)[_JAW] @ mean
    columns = slice(9 * (_JAW - 1), 9 * _JAW)  # nine columns per joint except the root
    shapes = {}
    for name, axis in _JAW_SHAPES.items():
        rotation = Rotation.from_rotvec(_JAW_STD_RAD * np.array(axis, float)).as_matrix()
        corrected = mean + corrections[..., columns] @ (rotation - np.eye(3)).ravel()
        skinned = corrected + weight * ((corrected - joint) @ (rotation - np.eye(3)).T)
        shapes[name] = (skinned - mean)[None].astype(np.float32)
    return shapes


def read_embedding(path: Path, mean: np.ndarray, triangles: np.ndarray) -> dict[int, np.ndarray]:
    """Read the landmarks on the mean [N, 3] by number; raises InputError for any other file."""
    require_regular(
        path, "pass FLAME's landmark embedding as --landmarks, such as DECA's landmark_embedding.npy"
    )
    with refusal(path, "an embedding of FLAME's 68 landmarks"):
        table = _table(path)
        keys = ("lmk_face_idx", "lmk_b_coords")
        if "full_lmk_faces_idx" in table:  # from DECA, with a leading axis
            keys = ("full_lmk_faces_idx", "full_lmk_bary_coords")
            table = {key: array[0] for key, array in table.items() if key in keys}
        faces, weights = numbers(table, keys[0], (68,)).astype(np.int64), numbers(table, keys[1], (68, 3))
        if not 0 <= faces.min() <= faces.max() < len(triangles) or abs(weights.sum(-1) - 1).max() > 0.01:
            raise ValueError("it belongs to another mesh")
    return dict(enumerate(np.einsum("nkc,nk->nc", mean[triangles[faces]], weights)))
