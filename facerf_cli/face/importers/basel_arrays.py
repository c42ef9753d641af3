"""The arrays in the Basel models' files, read by scipy and HDF5, which a damaged file can crash.

`basel` runs this in a process of its own (`files/apart.py`).
"""

from pathlib import Path
from typing import Any

import numpy as np

MAX_BYTES, MAX_ENTRIES, MAX_SHAPES = 1 << 30, 120_000_000, 500
_MAX_TEXT = 1 << 20  # bytes of the landmarks' JSON
_ARRAYS_2009 = ("shapeMU", "shapePC", "shapeEV", "tl")
_NUMBERS = ("single", "double", "int16", "uint16", "int32", "uint32", "int64", "uint64")  # kinds of arrays
_MODEL = ("mean", "pcaBasis", "pcaVariance")
CELLS, LANDMARKS = "shape/representer/cells", "metadata/landmarks/json"


def arrays_2009(path: Path) -> dict[str, np.ndarray]:
    """The arrays of `01_MorphableModel.mat`; raises ValueError where one is missing or too large."""
    import scipy.io

    if path.stat().st_size > MAX_BYTES:
        raise ValueError("it is too large")
    listed = {name: (shape, kind) for name, shape, kind in scipy.io.whosmat(path)}
    for name in _ARRAYS_2009:
        if name not in listed:
            raise ValueError(f"it lacks {name}")
        shape, kind = listed[name]
        if len(shape) != 2 or shape[0] * shape[1] > MAX_ENTRIES or kind not in _NUMBERS:
            raise ValueError(f"{name} is a {kind} of shape {list(shape)}")
    raw = scipy.io.loadmat(path, variable_names=_ARRAYS_2009)  # numbers only: no objects, no functions
    return {name: raw[name] for name in _ARRAYS_2009}


def arrays_2017(path: Path) -> dict[str, np.ndarray]:
    """The arrays of `model2017-1_*.h5` by their paths, and the bytes of the landmarks' JSON, if any."""
    import h5py

    names = [f"{group}/model/{name}" for group in ("shape", "expression") for name in _MODEL]
    with h5py.File(path, "r", locking=False) as file:
        arrays = {name: _numbers(file, name) for name in (*names, CELLS)}
        text = _landmarks(file)
    return arrays | ({} if text is None else {LANDMARKS: np.frombuffer(text, np.uint8)})


def _landmarks(file: Any) -> bytes | None:
    """The JSON of named points as bytes; None where the file names none."""
    if LANDMARKS not in file:
        return None
    dataset = file[LANDMARKS]
    if dataset.nbytes > _MAX_TEXT:
        raise ValueError(f"{LANDMARKS} is too long")
    stored = dataset[()]  # text, bytes, or an array of one text or of its bytes
    if isinstance(stored, np.ndarray) and stored.dtype.kind in "OSU" and stored.size == 1:
        stored = stored.item()
    if isinstance(stored, str):
        return stored.encode()
    return stored if isinstance(stored, bytes) else np.asarray(stored).tobytes()


def _numbers(file: Any, name: str) -> np.ndarray:
    """Read the numbers of a dataset; raises ValueError where it is missing, too large or not finite."""
    if name not in file:
        raise ValueError(f"it lacks {name}")
    dataset = file[name]
    if dataset.dtype.kind not in "fiu" or dataset.size > MAX_ENTRIES or dataset.ndim > 2:
        raise ValueError(f"{name} is {dataset.dtype} of shape {list(dataset.shape)}")
    values = dataset[()]
    if not np.isfinite(values).all():
        raise ValueError(f"{name} holds values that are not finite")
    return values.astype(np.float64) if values.ndim < 2 else values
