"""Tables of arrays in pickles, as FLAME's are: Python's unpickler with names from an allow-list.

The classes and functions of other packages become stand-ins, which only keep what they are given; arrays are
then read over the file's own bytes. So no code of a file runs, and FLAME opens without chumpy. Damage can
still exhaust or crash the unpickler: read a user's file in a process of its own (`files/apart.py`).
"""

import pickle
import re
from pathlib import Path
from typing import Any

import numpy as np
from scipy import sparse

_BUILT = re.compile(
    r"(copy_reg|copyreg)\._reconstructor|_codecs\.encode|__builtin__\.(bytes|object|set)"
    r"|builtins\.(object|set)|collections\.OrderedDict"
)
_KEPT = re.compile(
    r"numpy\.(_?core\.multiarray\.(_reconstruct|scalar)|_?core\.numeric\._frombuffer|dtype|ndarray)"
    r"|(chumpy|torch|scipy\.sparse)\..*"
)
_NUMBERS = re.compile(r"f[248]|[iu][1248]|b1")  # types that are read: no objects, text or records


class _StandIn:
    """An object that is not made: the name of its class, what that is called with, and the state."""

    name = ""
    arguments: tuple[Any, ...] = ()
    state: Any = None

    def __new__(cls, *arguments: Any) -> "_StandIn":
        made = super().__new__(cls)
        made.arguments = arguments
        return made

    def __setstate__(self, state: Any) -> None:
        self.state = state


class _Unpickler(pickle.Unpickler):
    def find_class(self, module: str, name: str) -> Any:
        """Return what an allowed name stands for."""
        whole = f"{module}.{name}"
        if _BUILT.fullmatch(whole):
            return super().find_class(module, name)
        if _KEPT.fullmatch(whole):
            return type("StandIn", (_StandIn,), {"name": whole})
        raise ValueError(f"it names {whole[:80]}, which is not part of a face model; nothing of it was run")


def pickled_arrays(path: Path) -> dict[str, np.ndarray]:
    """The numbers of a pickled table, or of a table in an .npy, by name; empty for a value without any."""
    with path.open("rb") as file:
        if path.suffix == ".npy":
            np.lib.format.read_magic(file)
            np.lib.format.read_array_header_1_0(file)
        table = _Unpickler(file, encoding="latin-1").load()
    match table:
        case _StandIn(state=(_, _, _StandIn(arguments=("O8" | "O", *_)), _, [entry])):  # by np.save
            table = entry
    if not isinstance(table, dict):
        raise ValueError(f"it holds a {type(table).__name__}, not a table of arrays")
    return {name: _numbers(value) for name, value in table.items() if isinstance(name, str)}


def _numbers(value: Any) -> np.ndarray:
    """The numbers in an array of numpy, chumpy or scipy.sparse, a scalar or a list."""
    match value:
        case _StandIn(name="chumpy.ch.Ch", state={"x": inner}):
            return _numbers(inner)
        case _StandIn(state={"indptr": starts, "indices": indices, "data": data, **state}):
            kind = sparse.csc_matrix if "csc" in value.name else sparse.csr_matrix
            parts = _numbers(data), _numbers(indices), _numbers(starts)
            matrix = kind(parts, state["_shape" if "_shape" in state else "shape"])
            matrix.check_format(full_check=True)
            return np.asarray(matrix.toarray())
        case _StandIn(state=(_, shape, _StandIn() as kind, fortran, raw)):
            return _array_over(raw, kind, shape, "F" if fortran else "C")
        case _StandIn(arguments=(raw, _StandIn() as kind, shape, order)):  # _frombuffer
            return _array_over(raw, kind, shape, order)
        case _StandIn(arguments=(_StandIn() as kind, raw)):  # scalar
            return _array_over(raw, kind, (), "C")
        case int() | float():
            return np.array(value)
        case [*entries] if all(isinstance(entry, (int, float)) for entry in entries):
            return np.array(entries)
    return np.zeros(0)


def _array_over(raw: Any, kind: _StandIn, shape: Any, order: Any) -> np.ndarray:
    """A view of a pickle's bytes, which Python 2 may have stored as text; empty for other than numbers."""
    code = str(kind.arguments[0])
    if not _NUMBERS.fullmatch(code):
        return np.zeros(0)
    dtype = np.dtype(code).newbyteorder(kind.state[1])
    data = raw.encode("latin-1") if isinstance(raw, str) else bytes(raw)
    return np.frombuffer(data, dtype).reshape(shape, order=order)
