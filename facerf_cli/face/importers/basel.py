"""The Basel Face Models of 2009, 2017 and 2019.

2009 (Paysan et al., 'A 3D Face Model for Pose and Illumination Invariant ...', 2009):
`PublicMM1/01_MorphableModel.mat`, MATLAB version 5, holds `shapeMU` [3 N, 1] in micrometres, `shapePC`
[3 N, 199] of unit length, `shapeEV` [199, 1], which are standard deviations in spite of their name, and `tl`
[F, 3] counted from 1 (as eos's convert-bfm2009-to-eos.py reads it, Apache-2.0). It has no expressions; those
of the built-in model replace them.

2017 and 2019 (Gerig et al., 'Morphable Face Models - An Open Framework'): HDF5 in statismo's layout holds,
under `shape` and `expression`, `model/mean` [3 N] in millimetres, `model/pcaBasis` [3 N, K] of unit length
and `model/pcaVariance` [K]; `shape/representer/cells` is [3, F]. The neutral face is the mean of the shapes.
The mean of the expressions is the average displacement of the scanned faces from it, up to 17 mm around an
open mouth. It becomes an expression shape here; together with it the others keep their second moments about
the neutral face. `metadata/landmarks/json`, written by scalismo, names points on the mean of the shapes as a
list of `id` and `coordinates`.
"""

import importlib.util
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from facerf_cli.errors import FacerfError, InputError
from facerf_cli.face.importers.source import SourceModel, require_mesh
from facerf_cli.files.apart import arrays_apart
from facerf_cli.files.texts import parse_json, require_regular
from facerf_cli.run.logs import one_line

_LICENCE_2009 = "Basel Face Model 2009, (c) University of Basel; non-commercial use, by its licence agreement"
_VERTICES_2009 = 53490
# MPEG-4 feature points among the 68 landmarks: number and vertex from 0, eos's ibug_to_bfm.txt (Apache-2.0).
_LANDMARKS_2009 = {
    **{17: 38792, 19: 40087, 21: 40514, 22: 41091, 24: 41511, 26: 42825, 30: 8319, 33: 8334, 36: 2088},
    **{39: 5959, 42: 10603, 45: 14472, 48: 5006, 51: 8344, 54: 11714, 57: 8374, 62: 8354, 66: 8366},
}
_ARRAYS_2009 = ("shapeMU", "shapePC", "shapeEV", "tl")
_LICENCE_2017 = (
    "Basel Face Model {year}, (c) University of Basel; non-commercial use, by its licence agreement"
)
_CELLS, _NAMED = "shape/representer/cells", "metadata/landmarks/json"
_ON_MEAN_M = 0.003  # a named point further from the surface is inside the head, such as that of a pupil
# The names of points among the 68 landmarks; 'right' is the subject's right, on the image's left.
_LANDMARKS_2017 = {
    "center.chin.tip": 8,
    "center.nose.tip": 30,
    "right.nose.wing.tip": 31,
    "center.nose.attachement_to_philtrum": 33,
    "left.nose.wing.tip": 35,
    "right.eye.corner_outer": 36,
    "right.eye.corner_inner": 39,
    "left.eye.corner_inner": 42,
    "left.eye.corner_outer": 45,
    "right.lips.corner": 48,
    "right.lips.philtrum_ridge": 50,
    "center.lips.upper.outer": 51,
    "left.lips.philtrum_ridge": 52,
    "left.lips.corner": 54,
    "center.lips.lower.outer": 57,
    "center.lips.upper.inner": 62,
    "center.lips.lower.inner": 66,
}
_MODEL_2017 = ("mean", "pcaBasis", "pcaVariance")
_MAX_SHAPES = 500


def read_basel_2009(path: Path) -> SourceModel:
    """Read the model from `01_MorphableModel.mat` or its folder; raises InputError for any other file."""
    if path.is_dir():
        path = next(iter(sorted(path.rglob("01_MorphableModel.mat"))), path / "01_MorphableModel.mat")
    require_regular(path, "give the Basel Face Model's 01_MorphableModel.mat")
    with _damage_in_one_line(path, "2009", "01_MorphableModel.mat"):
        mean, basis, deviations, corners = arrays_apart(arrays_2009, path).values()
        mean = mean.astype(np.float64) / 1e6
        mean, identity = _linear_model(mean, basis, deviations.astype(np.float32) / 1e6, "shapePC")
        triangles = corners.astype(np.int64) - 1
        require_mesh(mean, triangles)
    is_published = len(mean) == _VERTICES_2009  # not cut or refined
    return SourceModel(
        name="basel-2009",
        licence=_LICENCE_2009,
        mean=mean,
        identity=identity,
        expression=np.zeros((0, len(mean), 3), np.float32),
        expression_names=(),
        triangles=triangles,
        known={number: mean[at] for number, at in _LANDMARKS_2009.items()} if is_published else {},
    )


def read_basel_2017(path: Path, kind: str = "basel-2017") -> SourceModel:
    """Read the model from `model2017-1_*.h5` or `model2019_*.h5`; raises InputError for any other file.

    Raises FacerfError where h5py, of the extra `face-models`, is missing.
    """
    if importlib.util.find_spec("h5py") is None:
        raise FacerfError("Basel Face Model: h5py is missing; run pip install 'facerf[face-models]'")
    require_regular(path, "give the Basel Face Model's .h5")
    year = kind.removeprefix("basel-")
    with _damage_in_one_line(path, year, "its .h5"):
        arrays = arrays_apart(arrays_2017, path)
        mean, identity = _linear_model_2017(arrays, "shape")
        usual, expression = _linear_model_2017(arrays, "expression")
        triangles = arrays[_CELLS].astype(np.int64).T
        if usual.shape != mean.shape:
            raise ValueError(f"its expressions have {len(usual)} vertices, its shapes {len(mean)}")
        require_mesh(mean, triangles)
        known = _known_2017(arrays[_NAMED].tobytes(), mean)
    names = tuple(f"expression_{index:03d}" for index in range(len(expression)))
    return SourceModel(
        name=kind,
        licence=_LICENCE_2017.format(year=year),
        mean=mean,
        identity=identity,
        expression=np.concatenate([usual[None].astype(expression.dtype), expression]),
        expression_names=("mean_expression", *names),
        triangles=triangles,
        known=known,
    )


@contextmanager
def _damage_in_one_line(path: Path, year: str, file: str) -> Iterator[None]:
    try:
        yield
    except (ValueError, KeyError, TypeError, IndexError, OverflowError, RecursionError) as error:
        raise InputError(
            f"{path}: not a Basel Face Model {year} ({one_line(str(error))[:160]}); "
            f"give {file} as it was downloaded"
        ) from None


def arrays_2009(path: Path) -> dict[str, np.ndarray]:
    """The arrays of `01_MorphableModel.mat`; called in a process of its own."""
    import scipy.io

    return _numbers(scipy.io.loadmat(path, variable_names=_ARRAYS_2009), _ARRAYS_2009)


def arrays_2017(path: Path) -> dict[str, np.ndarray]:
    """The arrays of `model2017-1_*.h5` by their paths; called in a process of its own.

    The landmarks' JSON becomes its bytes; none where the file names no landmarks.
    """
    import h5py

    parts = [f"{group}/model/{name}" for group in ("shape", "expression") for name in _MODEL_2017]
    with h5py.File(path, "r", locking=False) as file:
        stored = file[_NAMED][()] if _NAMED in file else b"[]"
        if isinstance(stored, np.ndarray) and stored.dtype.kind in "OSU" and stored.size == 1:
            stored = stored.item()  # an array of one text; or else text, bytes, or an array of its bytes
        text = stored.encode() if isinstance(stored, str) else np.asarray(stored).tobytes()
        return _numbers(file, (*parts, _CELLS)) | {_NAMED: np.frombuffer(text, np.uint8)}


def _numbers(file: Mapping[str, Any], names: Iterable[str]) -> dict[str, np.ndarray]:
    """Arrays of a file by name; raises ValueError where one is missing, or holds anything but numbers."""
    arrays = {}
    for name in names:
        if name not in file:
            raise ValueError(f"it lacks {name}")
        array = np.asarray(file[name][()])
        if array.dtype.kind not in "fiu" or not np.isfinite(array).all():
            raise ValueError(f"{name} is {array.dtype}, or holds values that are not finite")
        arrays[name] = array
    return arrays


def _linear_model(
    mean: np.ndarray, basis: np.ndarray, deviations: np.ndarray, name: str
) -> tuple[np.ndarray, np.ndarray]:
    """Mean [N, 3], and basis [K, N, 3] in units per standard deviation, of 3 N numbers and a unit basis."""
    mean, deviations = mean.ravel(), deviations.ravel()
    count = len(deviations)
    if basis.shape != (len(mean), count) or len(mean) % 3 or not 1 <= count <= _MAX_SHAPES:
        raise ValueError(f"{name} has shape {list(basis.shape)}, not [{len(mean)}, {count}]")
    return mean.reshape(-1, 3), (basis * deviations).T.reshape(count, -1, 3)


def _linear_model_2017(arrays: Mapping[str, np.ndarray], group: str) -> tuple[np.ndarray, np.ndarray]:
    """Mean and basis in metres of the shapes or the expressions."""
    mean, basis, variance = (arrays[f"{group}/model/{name}"] for name in _MODEL_2017)
    if (variance < 0).any():
        raise ValueError(f"{group}/model/pcaVariance is negative")
    name = f"{group}/model/pcaBasis"
    deviations = np.sqrt(variance.astype(np.float64)) / 1000
    made = _linear_model(mean.astype(np.float64) / 1000, basis, deviations, name)
    if not np.allclose(np.linalg.norm(basis[:, 0].astype(np.float64)), 1, atol=0.01):
        raise ValueError(f"{name} is not of unit length")
    return made


def _known_2017(text: bytes, mean: np.ndarray) -> dict[int, np.ndarray]:
    """The known landmarks on the mean [N, 3] by number, from the JSON of named points."""
    known = {}
    for entry in parse_json(text):
        number = _LANDMARKS_2017.get(str(entry["id"]))
        point = np.array(entry["coordinates"], dtype=np.float64) / 1000
        if number is None or point.shape != (3,) or not np.isfinite(point).all():
            continue
        nearest = np.linalg.norm(mean - point, axis=-1).argmin()
        if np.linalg.norm(mean[nearest] - point) < _ON_MEAN_M:
            known[number] = mean[nearest]
    return known
