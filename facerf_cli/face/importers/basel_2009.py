"""Basel Face Model 2009 (Paysan et al., 'A 3D Face Model for Pose and Illumination Invariant ...', 2009).

`PublicMM1/01_MorphableModel.mat`, MATLAB version 5: `shapeMU` [3 N, 1] in micrometres, `shapePC` [3 N, 199]
of unit length, `shapeEV` [199, 1], which are standard deviations in spite of their name, and `tl` [F, 3] from
1 on (as eos's convert-bfm2009-to-eos.py reads it, Apache-2.0). It has no expressions; the built-in model's
stand in for them.
"""

import zlib
from pathlib import Path

import numpy as np
import scipy.io
from scipy.io.matlab import MatReadError

from facerf_cli.errors import InputError
from facerf_cli.face.importers.source import SourceModel, require_mesh
from facerf_cli.records import one_line

_MAX_BYTES, _MAX_ENTRIES, _MAX_SHAPES = 1 << 30, 120_000_000, 500
_LICENCE = "Basel Face Model 2009, (c) University of Basel; non-commercial use, by its licence agreement"
_NAMES = ("shapeMU", "shapePC", "shapeEV", "tl")
_NUMBERS = ("single", "double", "int16", "uint16", "int32", "uint32", "int64", "uint64")
_DAMAGED = (
    NotImplementedError,
    ValueError,
    TypeError,
    KeyError,
    IndexError,
    OSError,
    EOFError,
    zlib.error,
    MatReadError,
)

_VERTICES = 53490
# MPEG-4 feature points that are among the 68, counted from 0: eos's ibug_to_bfm.txt (Apache-2.0).
_LANDMARKS = """
17 38792 | 19 40087 | 21 40514 | 22 41091 | 24 41511 | 26 42825 | 30 8319 | 33 8334 | 36 2088 | 39 5959
42 10603 | 45 14472 | 48 5006 | 51 8344 | 54 11714 | 57 8374 | 62 8354 | 66 8366
"""


def read_basel_2009(path: Path) -> SourceModel:
    """The model from `01_MorphableModel.mat`, or the folder that has it; an InputError for what is none."""
    if path.is_dir():
        path = next(iter(sorted(path.rglob("01_MorphableModel.mat"))), path / "01_MorphableModel.mat")
    if not path.is_file():
        raise InputError(f"{path}: no such file; give the Basel Face Model's 01_MorphableModel.mat")
    try:
        mean, basis, deviations, triangles = _arrays(path)
        require_mesh(mean, triangles)
    except _DAMAGED as error:
        raise InputError(
            f"{path}: not a Basel Face Model 2009 ({one_line(str(error))[:160]}); "
            "give 01_MorphableModel.mat as it was downloaded"
        ) from None
    return SourceModel(
        name="basel-2009",
        licence=_LICENCE,
        mean=mean,
        identity=(basis * deviations).T.reshape(-1, len(mean), 3),
        expression=np.zeros((0, len(mean), 3), np.float32),
        expression_names=(),
        triangles=triangles,
        known=_known(mean),
    )


def _arrays(path: Path) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Mean [N, 3] and basis [3 N, K] in metres per deviation, deviations [K], triangles [F, 3] from 0 on."""
    if path.stat().st_size > _MAX_BYTES:
        raise ValueError("it is too large")
    listed = {name: (shape, kind) for name, shape, kind in scipy.io.whosmat(path)}
    for name in _NAMES:
        if name not in listed:
            raise ValueError(f"it lacks {name}")
        shape, kind = listed[name]
        if len(shape) != 2 or shape[0] * shape[1] > _MAX_ENTRIES or kind not in _NUMBERS:
            raise ValueError(f"{name} is a {kind} of shape {list(shape)}")
    raw = scipy.io.loadmat(path, variable_names=_NAMES)  # numbers alone: no objects, no functions
    mean, basis, deviations = (raw[name] for name in _NAMES[:3])
    mean, deviations = mean.ravel().astype(np.float64), deviations.ravel().astype(np.float32)
    if basis.shape != (len(mean), len(deviations)) or len(mean) % 3 or len(deviations) > _MAX_SHAPES:
        raise ValueError(f"shapePC has shape {list(basis.shape)}, not [{len(mean)}, {len(deviations)}]")
    if not all(np.isfinite(field).all() for field in (mean, basis, deviations)):
        raise ValueError("it holds values that are not finite")
    triangles = raw["tl"].astype(np.int64) - 1
    return mean.reshape(-1, 3) / 1e6, basis, deviations / 1e6, triangles


def _known(mean: np.ndarray) -> dict[int, np.ndarray]:
    """The named landmarks of the published mesh; of a cut or refined one nothing is known."""
    if len(mean) != _VERTICES:
        return {}
    pairs = (cell.split() for cell in _LANDMARKS.strip().replace("\n", "|").split("|"))
    return {int(number): mean[int(vertex)] for number, vertex in pairs}
