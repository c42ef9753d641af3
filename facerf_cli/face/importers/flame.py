"""FLAME (Li et al., 'Learning a model of facial shape and expression from 4D scans', SIGGRAPH Asia 2017).

Its files of 2019 to 2023 hold `v_template` [5023, 3] in metres, `f` [9976, 3], and `shapedirs`
[5023, 3, 400]: 300 shapes of identity and 100 of expression, scaled by their standard deviations (as smplx
and DECA read them). FLAME opens the mouth by turning the jaw, which is not a shape; `posedirs`, `weights` and
`J_regressor` become three jaw shapes here. In `flame2023_no_jaw.pkl` the expressions open the mouth and the
jaw never turns.

An embedding places landmarks on the mesh by a triangle and barycentric weights for each point. The file is
`landmark_embedding.npy` (DECA: a pickled table with all 68 as `full_lmk_faces_idx` and
`full_lmk_bary_coords`, the 51 inner ones as `static_...`), or a file with `lmk_face_idx` and `lmk_b_coords`
of 51 or 68 points (FLAME's `flame_static_embedding.pkl`, and .npz files).
"""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from facerf_cli.errors import InputError
from facerf_cli.face.importers.source import SourceModel, require_mesh
from facerf_cli.face.morphable import read_npz
from facerf_cli.files.apart import arrays_apart
from facerf_cli.files.inert_pickle import pickled_arrays
from facerf_cli.files.texts import require_regular
from facerf_cli.run.logs import one_line

IDENTITIES = 300  # the first shapes; the others are expressions
_MAX_SHAPES = 500
_LICENCE = (
    "FLAME, (c) Max-Planck-Gesellschaft; under the licence that its download came with "
    "(flame.is.tue.mpg.de; non-commercial research, unless that says otherwise)"
)
_OPEN_LICENCE = "FLAME 2023 Open, (c) Max-Planck-Gesellschaft; CC BY 4.0 (flame.is.tue.mpg.de)"
_OPEN_KEY = "supr_expression_metadata"  # only FLAME 2023 Open has it
_NO_JAW = "no_jaw"  # in a file's name; its content has no such mark
_JAW, _JOINTS = 2, 5  # joints: root, neck, jaw and two eyes
_JAW_STD_RAD = 0.1  # a coefficient of 3 opens a mouth by 17 degrees
_JAW_SHAPES = {  # turns of the jaw as axes in units of _JAW_STD_RAD
    "jaw_open": (1, 0, 0),
    "jaw_turn": (0, 0.3, 0),
    "jaw_roll": (0, 0, 0.3),
}
_EMBEDDING_KEYS = (
    ("full_lmk_faces_idx", "full_lmk_bary_coords"),
    ("lmk_face_idx", "lmk_b_coords"),
    ("static_lmk_faces_idx", "static_lmk_bary_coords"),
)
_INNER = 51  # landmarks without the contour: the last of the 68


def read_flame(path: Path, landmarks: Path | None = None) -> SourceModel:
    """Read FLAME from its .pkl, from an .npz of the same arrays, or from a folder with one such file.

    landmarks is an embedding; the default is `landmark_embedding.npy` in the model's folder. Landmarks
    without an embedding are found later by shape. Raises InputError for any other file.
    """
    path = _model_file(path)
    embedding = landmarks or path.with_name("landmark_embedding.npy")
    try:
        source = _source(_table(path), path.stem)
    except (KeyError, ValueError, TypeError) as error:
        reason = f"it lacks {error}" if isinstance(error, KeyError) else one_line(str(error))[:160]
        raise InputError(f"{path}: not a FLAME model ({reason}); download it again") from None
    if landmarks or embedding.is_file():
        source.known.update(read_embedding(embedding, source.mean, source.triangles))
    return source


def _table(path: Path) -> dict[str, np.ndarray]:
    return read_npz(path) if path.suffix == ".npz" else arrays_apart(pickled_arrays, path)


def _model_file(path: Path) -> Path:
    """The model's file: `path`, or the only model in a folder."""
    if not path.is_dir():
        if path.suffix not in (".pkl", ".npz") or not path.is_file():
            wrong = "" if path.exists() else "no such file; "
            raise InputError(
                f"{path}: {wrong}give FLAME's .pkl, an .npz of the same arrays, or the folder of one"
            )
        return path
    models = [file for file in sorted(path.iterdir()) if file.suffix in (".pkl", ".npz")]
    models = [file for file in models if not any(word in file.name.lower() for word in ("embedding", "mask"))]
    if len(models) != 1:
        names = ", ".join(file.name for file in models[:6]) or "none"
        raise InputError(f"{path}: give one of FLAME's .pkl files by name (here: {names})")
    return models[0]


def _source(raw: Mapping[str, np.ndarray], stem: str) -> SourceModel:
    mean = raw["v_template"].astype(np.float64)
    triangles = raw["f"].astype(np.int64)
    shapes = raw["shapedirs"]
    require_mesh(mean, triangles)
    if shapes.ndim != 3 or shapes.shape[:2] != mean.shape or not 1 <= shapes.shape[2] <= _MAX_SHAPES:
        raise ValueError(f"shapedirs has shape {list(shapes.shape)}, not [{len(mean)}, 3, 400]")
    if not np.isfinite(shapes).all():
        raise ValueError("shapedirs holds values that are not finite")
    bases = np.moveaxis(shapes, -1, 0).astype(np.float32)
    jaw = {} if _NO_JAW in stem else _jaw_shapes(mean, raw)
    names = tuple(f"expression_{index:03d}" for index in range(len(bases[IDENTITIES:])))
    return SourceModel(
        name="flame",
        licence=_OPEN_LICENCE if _OPEN_KEY in raw else _LICENCE,
        mean=mean,
        identity=bases[:IDENTITIES],
        expression=np.concatenate([bases[IDENTITIES:], *jaw.values()]),
        expression_names=names + tuple(jaw),
        triangles=triangles,
    )


def _jaw_shapes(mean: np.ndarray, raw: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Jaw turns of one standard deviation [1, N, 3] by name (linear blend skinning, FLAME's equation 2).

    {} for a file without a skeleton. Raises ValueError for a skeleton that is not FLAME's.
    """
    keys = ("posedirs", "weights", "J_regressor")
    if not all(key in raw for key in keys):
        return {}
    corrections, weights, regressor = (raw[key].astype(np.float64) for key in keys)
    wanted = ((*mean.shape, 9 * (_JOINTS - 1)), (len(mean), _JOINTS), (_JOINTS, len(mean)))
    for key, array, shape in zip(keys, (corrections, weights, regressor), wanted, strict=True):
        if array.shape != shape or not np.isfinite(array).all():
            raise ValueError(f"{key} has shape {list(array.shape)}, not {list(shape)}, or is not finite")
    joint, weight = regressor[_JAW] @ mean, weights[:, _JAW, None]
    own = slice(9 * (_JAW - 1), 9 * _JAW)  # nine columns for each joint's turn but the root's
    shapes = {}
    for name, axis in _JAW_SHAPES.items():
        turn = Rotation.from_rotvec(_JAW_STD_RAD * np.array(axis, float)).as_matrix()
        corrected = mean + corrections[..., own] @ (turn - np.eye(3)).ravel()
        skinned = corrected + weight * ((corrected - joint) @ (turn - np.eye(3)).T)
        shapes[name] = (skinned - mean)[None].astype(np.float32)
    return shapes


def read_embedding(path: Path, mean: np.ndarray, triangles: np.ndarray) -> dict[int, np.ndarray]:
    """Read landmarks on the mean [N, 3] by number; raises InputError for a file without an embedding."""
    try:
        require_regular(path)
        table = _table(path)
        named = [keys for keys in _EMBEDDING_KEYS if table.keys() >= set(keys)]
        if not named:
            raise ValueError(f"none of {', '.join(key for keys in _EMBEDDING_KEYS for key in keys)}")
        faces, weights = (table[key] for key in named[0])
        faces, weights = faces.astype(np.int64).ravel(), weights.astype(np.float64).reshape(-1, 3)
        if len(faces) not in (_INNER, 68) or len(weights) != len(faces):
            raise ValueError(f"it has {len(faces)} points and {len(weights)} weights")
        if not (0 <= faces.min() <= faces.max() < len(triangles)) or abs(weights.sum(-1) - 1).max() > 0.01:
            raise ValueError("it belongs to another mesh")
    except (ValueError, TypeError) as error:
        raise InputError(
            f"{path}: no landmarks ({one_line(str(error))[:160]}); give an embedding of FLAME's landmarks"
        ) from None
    points = np.einsum("nkc,nk->nc", mean[triangles[faces]], weights)
    return dict(zip(range(68 - len(points), 68), points, strict=True))
