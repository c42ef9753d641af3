"""Importer of the Basel Face Models of 2009, 2017 and 2019.

2009 (Paysan et al.): a MATLAB 5 .mat with `shapeMU` [3 N, 1] in micrometres, `shapePC` [3 N, 199] of unit
length, `shapeEV` [199, 1], which contains standard deviations in spite of its name, and `tl` [F, 3] counted
from 1 (like eos's convert-bfm2009-to-eos.py, Apache-2.0). It has no expressions.

2017 and 2019 (Gerig et al., 'Morphable Face Models - An Open Framework'): HDF5 in statismo's layout with
`model/mean` [3 N] in millimetres, `model/pcaBasis` [3 N, K] of unit length and `model/pcaVariance` [K] under
`shape` and `expression`; `shape/representer/cells` is [3, F]. The neutral face is the mean of the shapes. The
mean of the expressions, up to 17 mm around an open mouth, becomes an additional expression shape, so that the
expressions keep their second moments about the neutral face.
"""

import importlib.util
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from facerf_cli.errors import FacerfError
from facerf_cli.face.importers.source import SourceModel, numbers, refusal
from facerf_cli.files.sandbox import read_in_subprocess
from facerf_cli.files.texts import parse_json, require_regular

_LICENCE = "Basel Face Model {year}, (c) University of Basel; non-commercial use, by its licence agreement"
# MPEG-4 feature points among the 68 landmarks: number and vertex from 0, eos's ibug_to_bfm.txt (Apache-2.0).
_LANDMARKS_2009 = {
    **{17: 38792, 19: 40087, 21: 40514, 22: 41091, 24: 41511, 26: 42825, 30: 8319, 33: 8334, 36: 2088},
    **{39: 5959, 42: 10603, 45: 14472, 48: 5006, 51: 8344, 54: 11714, 57: 8374, 62: 8354, 66: 8366},
}
_MODEL = ("mean", "pcaBasis", "pcaVariance")
_CELLS, _NAMED = "shape/representer/cells", "metadata/landmarks/json"
_ON_MEAN_M = 0.003  # largest distance from the surface; points inside the head, such as pupils, are ignored
# Names of points among the 68 landmarks; 'right' is the subject's right, on the image's left.
_LANDMARKS_2017 = {
    **{"center.chin.tip": 8, "center.nose.tip": 30, "center.nose.attachement_to_philtrum": 33},
    **{"right.nose.wing.tip": 31, "right.eye.corner_outer": 36, "right.eye.corner_inner": 39},
    **{"left.nose.wing.tip": 35, "left.eye.corner_inner": 42, "left.eye.corner_outer": 45},
    **{"right.lips.corner": 48, "right.lips.philtrum_ridge": 50, "center.lips.upper.outer": 51},
    **{"left.lips.philtrum_ridge": 52, "left.lips.corner": 54, "center.lips.lower.outer": 57},
    **{"center.lips.upper.inner": 62, "center.lips.lower.inner": 66},
}


def read_basel(path: Path) -> SourceModel:
    """Read 01_MorphableModel.mat, or an .h5 of the year in its name; raises InputError for other files."""
    require_regular(path, "use the Basel Face Model's 01_MorphableModel.mat or .h5")
    year = "2009" if path.suffix.lower() == ".mat" else "2019" if "2019" in path.name else "2017"
    if year != "2009" and importlib.util.find_spec("h5py") is None:
        raise FacerfError("Basel Face Model: h5py is missing; run pip install 'facerf[face-models]'")
    with refusal(path, f"a Basel Face Model {year}"):
        raw = read_in_subprocess(arrays_2009 if year == "2009" else arrays_2017, path)
        mean, identity = _linear_model(raw, "shape")
        names: tuple[str, ...] = ()
        known: dict[int, np.ndarray] = {}
        if year == "2009":
            expression = np.zeros((0, *mean.shape), np.float32)
            if len(mean) == 53490:  # the published mesh
                known = {number: mean[vertex] for number, vertex in _LANDMARKS_2009.items()}
        else:
            mean_expression, expression = _linear_model(raw, "expression")
            names = ("mean_expression", *(f"expression_{index:03d}" for index in range(len(expression))))
            expression = np.concatenate([mean_expression[None].astype(np.float32), expression])
            known = _known_2017(raw[_NAMED].tobytes(), mean)
        cells = numbers(raw, _CELLS, (3, None)).astype(np.int64).T
        licence = _LICENCE.format(year=year)
        return SourceModel(f"basel-{year}", licence, mean, identity, expression, names, cells, known)


def arrays_2009(path: Path) -> dict[str, np.ndarray]:
    """Read the .mat's arrays with the names and units of an .h5; runs in a separate process."""
    import scipy.io

    raw = scipy.io.loadmat(path, variable_names=("shapeMU", "shapePC", "shapeEV", "tl"))
    mean_mm, deviations_mm = (raw[name].ravel() / 1e3 for name in ("shapeMU", "shapeEV"))
    model = (mean_mm, raw["shapePC"], deviations_mm**2, raw["tl"].T - 1.0)
    return dict(zip((*(f"shape/model/{name}" for name in _MODEL), _CELLS), model, strict=True))


def arrays_2017(path: Path) -> dict[str, np.ndarray]:
    """Read the .h5's arrays by path, and its landmarks' JSON as bytes; runs in a separate process."""
    import h5py

    names = [_CELLS, *(f"{group}/model/{name}" for group in ("shape", "expression") for name in _MODEL)]
    with h5py.File(path, "r", locking=False) as file:
        arrays = {name: np.asarray(file[name][()]) for name in names if name in file}
        stored = np.asarray(file[_NAMED][()] if _NAMED in file else b"[]")
        text = stored.astype("S") if stored.dtype.kind == "O" else stored
        return arrays | {_NAMED: np.frombuffer(text.tobytes().rstrip(b"\0"), np.uint8)}


def _linear_model(raw: Mapping[str, np.ndarray], group: str) -> tuple[np.ndarray, np.ndarray]:
    """Convert a group to its mean [N, 3] and its basis [K, N, 3] per standard deviation, in metres."""
    mean, basis, variance = (f"{group}/model/{name}" for name in _MODEL)
    mean_mm, variances = numbers(raw, mean, (None,)).astype(np.float64), numbers(raw, variance, (None,))
    unit = numbers(raw, basis, (len(mean_mm), len(variances)))
    if (variances < 0).any():
        raise ValueError(f"{variance} is negative")
    if not np.allclose(np.linalg.norm(unit[:, 0].astype(np.float64)), 1, atol=0.01):
        raise ValueError(f"{basis} does not have unit length")
    scaled = (unit * (np.sqrt(variances) / 1000)).astype(np.float32)
    return mean_mm.reshape(-1, 3) / 1000, scaled.T.reshape(len(variances), -1, 3)


def _known_2017(text: bytes, mean: np.ndarray) -> dict[int, np.ndarray]:
    """Look up the landmarks on the mean [N, 3] by number, in the JSON of named points."""
    known = {}
    for entry in parse_json(text):
        number, point = _LANDMARKS_2017.get(str(entry["id"])), np.array(entry["coordinates"], float) / 1000
        distance_m = np.linalg.norm(mean - point, axis=-1)
        if number is not None and distance_m.min() < _ON_MEAN_M:
            known[number] = mean[distance_m.argmin()]
    return known
