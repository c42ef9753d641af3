"""Tables of arrays in pickles, as FLAME's are: Python's unpickler with names from an allow-list.

numpy builds its own arrays. The classes of other packages become stand-ins, which only keep what they are
given, so no code of a file runs, and FLAME opens without chumpy. Damage can still exhaust or crash the
unpickler: read a user's file in a process of its own (`files/apart.py`).
"""

import pickle
import re
from pathlib import Path
from typing import Any

import numpy as np
from scipy import sparse

_BUILT = re.compile(
    r"numpy\.(_?core\.multiarray\.(_reconstruct|scalar)|_?core\.numeric\._frombuffer|ndarray)"
    r"|(copy_reg|copyreg)\._reconstructor|_codecs\.encode|__builtin__\.(bytes|object|set)"
    r"|builtins\.(object|set)|collections\.OrderedDict"
)
_KEPT = re.compile(r"(chumpy|torch|scipy\.sparse)\..*")
_TYPES = re.compile(
    r"f[248]|[iu][1248]|b1|[SU]\d{1,4}|O8?"
)  # no records: their states could lie about objects


class _StandIn:
    """An object of a package that is not imported, with its state alone."""

    name = ""
    state: Any = None

    def __new__(cls, *_: Any) -> "_StandIn":
        return super().__new__(cls)

    def __setstate__(self, state: Any) -> None:
        self.state = state


class _Unpickler(pickle.Unpickler):
    def find_class(self, module: str, name: str) -> Any:
        """Return what an allowed name stands for."""
        whole = f"{module}.{name}"
        if whole == "numpy.dtype":
            return _dtype
        if _BUILT.fullmatch(whole):
            return super().find_class(module.replace("numpy.core", "numpy._core"), name)
        if _KEPT.fullmatch(whole):
            return type("StandIn", (_StandIn,), {"name": whole})
        raise ValueError(f"it names {whole[:80]}, which is not part of a face model; nothing of it was run")


def _dtype(code: str, *_: Any) -> np.dtype:
    if not _TYPES.fullmatch(code):
        raise ValueError(f"it holds an array of type {code[:20]}")
    return np.dtype(code, copy=True)  # its byte order is set later


def pickled_arrays(path: Path) -> dict[str, np.ndarray]:
    """The numbers of a pickled table, or of a table in an .npy, by name; empty for a value without any."""
    with path.open("rb") as file:
        if path.suffix == ".npy":
            np.lib.format.read_magic(file)
            np.lib.format.read_array_header_1_0(file)
        table = _Unpickler(file, encoding="latin-1").load()
    if isinstance(table, np.ndarray) and table.size == 1:  # one object, by np.save
        table = table.item()
    if not isinstance(table, dict):
        raise ValueError(f"it holds a {type(table).__name__}, not a table of arrays")
    return {name: _numbers(value) for name, value in table.items() if isinstance(name, str)}


def _numbers(value: Any) -> np.ndarray:
    """The numbers in an array of numpy, chumpy or scipy.sparse, a scalar or a list."""
    match value:
        case _StandIn(name="chumpy.ch.Ch", state={"x": inner}):
            value = inner
        case _StandIn(state={"indptr": starts, "indices": indices, "data": data, **state}):
            kind = sparse.csc_matrix if "csc" in value.name else sparse.csr_matrix
            matrix = kind((data, indices, starts), state["_shape" if "_shape" in state else "shape"])
            matrix.check_format(full_check=True)
            value = matrix.toarray()
    try:
        array = np.asarray(value)
    except ValueError:  # a list of lists of different lengths
        return np.zeros(0)
    return array if array.dtype.kind in "biuf" else np.zeros(0)
