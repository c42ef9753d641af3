"""Tables of arrays in pickles, as FLAME's are: Python's unpickler with an allow-list of names.

Only arrays of numpy and scipy, and plain containers, are made; classes of chumpy and torch become stand-ins.
Damage can still exhaust or crash the unpickler: read a user's file in a process of
its own (`files/apart.py`).
"""

import pickle
import re
from pathlib import Path
from typing import Any

import numpy as np
from scipy import sparse

_ALLOWED = re.compile(
    r"numpy\.(_core\.(multiarray\.(_reconstruct|scalar)|numeric\._frombuffer)|dtype|ndarray)"
    r"|scipy\.sparse\._cs[cr]\.cs[cr]_(matrix|array)|_codecs\.encode|copyreg\._reconstructor"
    r"|builtins\.(bytes|object|set)|collections\.OrderedDict"
)
# The names of Python 2, and of older numpy and scipy.
_MOVED = {"numpy.core": "numpy._core", "scipy.sparse.cs": "scipy.sparse._cs", "copy_reg": "copyreg"}
_MOVED["__builtin__"] = "builtins"


class _Unread:
    """Stands for what is not made, such as tensors of torch."""

    x: Any = None

    def __new__(cls, *_: Any) -> "_Unread":
        return super().__new__(cls)

    def __setstate__(self, state: Any) -> None:
        pass


class _Chumpy(_Unread):
    """Stands for an array of chumpy, whose values are `x` of its state."""

    def __setstate__(self, state: Any) -> None:
        self.x = state["x"]


class _Unpickler(pickle.Unpickler):
    def find_class(self, module: str, name: str) -> Any:
        """Return what an allowed name stands for; raises ValueError for any other."""
        if module.startswith(("chumpy.", "torch.")):
            return _Chumpy if (module, name) == ("chumpy.ch", "Ch") else _Unread
        for old, new in _MOVED.items():
            module = new + module.removeprefix(old) if module.startswith(old) else module
        if _ALLOWED.fullmatch(f"{module}.{name}"):
            return super().find_class(module, name)
        whole = f"{module}.{name}"[:80]
        raise ValueError(f"it names {whole}, which is not part of a face model; nothing of it was run")


def pickled_arrays(path: Path) -> dict[str, np.ndarray]:
    """Return the numbers of a pickled table, or of a table in an .npy, by name; empty for other values."""
    with path.open("rb") as file:
        if path.suffix == ".npy":
            np.lib.format.read_magic(file)
            np.lib.format.read_array_header_1_0(file)
        table = _Unpickler(file, encoding="latin-1").load()
    if isinstance(table, np.ndarray) and table.dtype == object and table.size == 1:  # by np.save
        table = table.item()
    if not isinstance(table, dict):
        raise ValueError(f"it holds a {type(table).__name__}, not a table of arrays")
    return {name: _numbers(value) for name, value in table.items() if isinstance(name, str)}


def _numbers(value: Any) -> np.ndarray:
    """Return the numbers in an array of numpy, chumpy or scipy.sparse, a scalar or a list."""
    value = value.x if isinstance(value, _Chumpy) else value
    if sparse.issparse(value):
        value.check_format(full_check=True)
        value = value.toarray()
    if isinstance(value, list) and not all(isinstance(entry, int | float) for entry in value):
        return np.zeros(0)
    array = (
        np.asarray(value) if isinstance(value, np.ndarray | np.generic | list | int | float) else np.zeros(0)
    )
    return array.astype(array.dtype.newbyteorder("=")) if array.dtype.kind in "biuf" else np.zeros(0)
