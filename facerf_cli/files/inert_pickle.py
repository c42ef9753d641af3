"""Arrays in pickles such as FLAME's, read through an allow-list of names.

Damage can still crash the unpickler: use a separate process for a user's file (`files/sandbox.py`).
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
# Module names of Python 2 and of older numpy and scipy.
_RENAMED = {"numpy.core": "numpy._core", "scipy.sparse.cs": "scipy.sparse._cs"}
_RENAMED |= {"copy_reg": "copyreg", "__builtin__": "builtins"}


class _StandIn:
    """Stand-in for an object of chumpy or torch, which is not created."""

    def __new__(cls, *_: Any) -> "_StandIn":
        return super().__new__(cls)

    def __setstate__(self, state: Any) -> None:
        pass


class _ChumpyArray(_StandIn):
    x: Any = None

    def __setstate__(self, state: Any) -> None:
        self.x = state["x"]


class _Unpickler(pickle.Unpickler):
    def find_class(self, module: str, name: str) -> Any:
        if module.startswith(("chumpy.", "torch.")):
            return _ChumpyArray if (module, name) == ("chumpy.ch", "Ch") else _StandIn
        for old, new in _RENAMED.items():
            module = new + module.removeprefix(old) if module.startswith(old) else module
        if _ALLOWED.fullmatch(f"{module}.{name}"):
            return super().find_class(module, name)
        raise ValueError(f"it names {f'{module}.{name}'[:80]}, which is not part of a face model")


def pickled_arrays(path: Path) -> dict[str, np.ndarray]:
    """Return the numbers of a pickled dict (.pkl, or one object in .npy) by name; empty for other values."""
    with path.open("rb") as file:
        if path.suffix == ".npy":
            np.lib.format.read_magic(file)
            np.lib.format.read_array_header_1_0(file)
        table = _Unpickler(file, encoding="latin-1").load()
    if isinstance(table, np.ndarray) and table.dtype == object and table.size == 1:  # by np.save
        table = table.item()
    if not isinstance(table, dict):
        raise ValueError(f"it contains a {type(table).__name__}, not a dict of arrays")
    return {name: _numbers(value) for name, value in table.items() if isinstance(name, str)}


def _numbers(value: Any) -> np.ndarray:
    value = value.x if isinstance(value, _ChumpyArray) else value
    if sparse.issparse(value):
        value.check_format(full_check=True)
        value = value.toarray()
    is_flat = not isinstance(value, list) or all(isinstance(entry, int | float) for entry in value)
    array = np.asarray(value if is_flat else None)
    return array.astype(array.dtype.newbyteorder("=")) if array.dtype.kind in "biuf" else np.zeros(0)
