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
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from facerf_cli.errors import FacerfError, InputError
from facerf_cli.face.importers.basel_arrays import CELLS, LANDMARKS, MAX_SHAPES
from facerf_cli.face.importers.source import SourceModel, require_mesh
from facerf_cli.files.apart import arrays_apart
from facerf_cli.files.texts import parse_json, require_regular
from facerf_cli.run.logs import one_line

_READERS = "facerf_cli.face.importers.basel_arrays"  # in a process of their own
_LICENCE_2009 = "Basel Face Model 2009, (c) University of Basel; non-commercial use, by its licence agreement"
_VERTICES_2009 = 53490
# MPEG-4 feature points among the 68 landmarks: number and vertex from 0, eos's ibug_to_bfm.txt (Apache-2.0).
_LANDMARKS_2009 = """
17 38792 | 19 40087 | 21 40514 | 22 41091 | 24 41511 | 26 42825 | 30 8319 | 33 8334 | 36 2088 | 39 5959
42 10603 | 45 14472 | 48 5006 | 51 8344 | 54 11714 | 57 8374 | 62 8354 | 66 8366
"""
_LICENCE_2017 = (
    "Basel Face Model {year}, (c) University of Basel; non-commercial use, by its licence agreement"
)
_YEARS = {"basel-2017": "2017", "basel-2019": "2019"}
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


def read_basel_2009(path: Path) -> SourceModel:
    """Read the model from `01_MorphableModel.mat` or its folder; raises InputError for any other file."""
    if path.is_dir():
        path = next(iter(sorted(path.rglob("01_MorphableModel.mat"))), path / "01_MorphableModel.mat")
    require_regular(path, "give the Basel Face Model's 01_MorphableModel.mat")
    try:
        mean, basis, deviations, triangles = _arrays_2009(path)
        require_mesh(mean, triangles)
    except (ValueError, KeyError, TypeError, IndexError) as error:
        raise InputError(
            f"{path}: not a Basel Face Model 2009 ({one_line(str(error))[:160]}); "
            "give 01_MorphableModel.mat as it was downloaded"
        ) from None
    return SourceModel(
        name="basel-2009",
        licence=_LICENCE_2009,
        mean=mean,
        identity=(basis * deviations).T.reshape(-1, len(mean), 3),
        expression=np.zeros((0, len(mean), 3), np.float32),
        expression_names=(),
        triangles=triangles,
        known=_known_2009(mean),
    )


def _arrays_2009(path: Path) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Mean [N, 3] in metres, unit basis [3 N, K], deviations [K] in metres, triangles [F, 3] from 0."""
    raw = arrays_apart(_READERS, "arrays_2009", path)
    mean, basis, deviations = (raw[name] for name in ("shapeMU", "shapePC", "shapeEV"))
    mean, deviations = mean.ravel().astype(np.float64), deviations.ravel().astype(np.float32)
    if basis.shape != (len(mean), len(deviations)) or len(mean) % 3 or len(deviations) > MAX_SHAPES:
        raise ValueError(f"shapePC has shape {list(basis.shape)}, not [{len(mean)}, {len(deviations)}]")
    if not all(np.isfinite(field).all() for field in (mean, basis, deviations, raw["tl"])):
        raise ValueError("it holds values that are not finite")
    triangles = raw["tl"].astype(np.int64) - 1
    return mean.reshape(-1, 3) / 1e6, basis, deviations / 1e6, triangles


def _known_2009(mean: np.ndarray) -> dict[int, np.ndarray]:
    """The known landmarks of the published mesh; none for a cut or refined mesh."""
    if len(mean) != _VERTICES_2009:
        return {}
    pairs = (cell.split() for cell in _LANDMARKS_2009.strip().replace("\n", "|").split("|"))
    return {int(number): mean[int(vertex)] for number, vertex in pairs}


def read_basel_2017(path: Path, kind: str = "basel-2017") -> SourceModel:
    """Read the model from `model2017-1_*.h5` or `model2019_*.h5`; raises InputError for any other file.

    Raises FacerfError where h5py, of the extra `face-models`, is missing.
    """
    if importlib.util.find_spec("h5py") is None:
        raise FacerfError("Basel Face Model: h5py is missing; run pip install 'facerf[face-models]'")
    require_regular(path, "give the Basel Face Model's .h5")
    try:
        return _source_2017(arrays_apart(_READERS, "arrays_2017", path), kind)
    except (ValueError, KeyError, TypeError, IndexError, OverflowError, RecursionError) as error:
        raise InputError(
            f"{path}: not a Basel Face Model {_YEARS[kind]} ({one_line(str(error))[:160]}); "
            "give its .h5 as it was downloaded"
        ) from None


def _source_2017(arrays: Mapping[str, np.ndarray], kind: str) -> SourceModel:
    mean, identity = _linear_model(arrays, "shape")
    usual, expression = _linear_model(arrays, "expression")
    triangles = arrays[CELLS].astype(np.int64).T
    if usual.shape != mean.shape:
        raise ValueError(f"its expressions have {len(usual)} vertices, its shapes {len(mean)}")
    require_mesh(mean, triangles)
    names = tuple(f"expression_{index:03d}" for index in range(len(expression)))
    return SourceModel(
        name=kind,
        licence=_LICENCE_2017.format(year=_YEARS[kind]),
        mean=mean,
        identity=identity,
        expression=np.concatenate([usual[None].astype(expression.dtype), expression]),
        expression_names=("mean_expression", *names),
        triangles=triangles,
        known=_known_2017(arrays, mean),
    )


def _linear_model(arrays: Mapping[str, np.ndarray], group: str) -> tuple[np.ndarray, np.ndarray]:
    """Mean [N, 3] in metres, and basis [K, N, 3] in metres per standard deviation."""
    mean, basis, variance = (arrays[f"{group}/model/{name}"] for name in ("mean", "pcaBasis", "pcaVariance"))
    mean, variance = mean.ravel(), variance.ravel()
    if basis.shape != (len(mean), len(variance)) or len(mean) % 3 or not 1 <= len(variance) <= MAX_SHAPES:
        raise ValueError(f"{group}/model/pcaBasis has shape {list(basis.shape)}")
    if not np.allclose(np.linalg.norm(basis[:, 0].astype(np.float64)), 1, atol=0.01):
        raise ValueError(f"{group}/model/pcaBasis is not of unit length")
    if (variance < 0).any():
        raise ValueError(f"{group}/model/pcaVariance is negative")
    scaled = basis * (np.sqrt(variance) / 1000)
    return mean.reshape(-1, 3) / 1000, scaled.T.reshape(len(variance), -1, 3)


def _known_2017(arrays: Mapping[str, np.ndarray], mean: np.ndarray) -> dict[int, np.ndarray]:
    """The known landmarks on the mean [N, 3] by number; none where the file names no points."""
    if LANDMARKS not in arrays:
        return {}
    known = {}
    for entry in parse_json(arrays[LANDMARKS].tobytes()):
        number = _LANDMARKS_2017.get(str(entry["id"]))
        point = np.array(entry["coordinates"], dtype=np.float64) / 1000
        if number is None or point.shape != (3,) or not np.isfinite(point).all():
            continue
        nearest = np.linalg.norm(mean - point, axis=-1).argmin()
        if np.linalg.norm(mean[nearest] - point) < _ON_MEAN_M:
            known[number] = mean[nearest]
    return known
