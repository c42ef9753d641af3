"""Pickles as the packages of others write them, made without those packages."""

import io
import pickle
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from types import ModuleType
from typing import Any

import numpy as np

PYTHON_2 = ((b"numpy._core.", b"numpy.core."), (b"scipy.sparse._csc", b"scipy.sparse.csc"))


@contextmanager
def chumpy() -> Iterator[type]:
    """chumpy's class of plain arrays, with the state that chumpy's ch.py gives it."""

    class Ch:
        def __init__(self, x: np.ndarray) -> None:
            self.x = np.asarray(x, np.float64)
            self._dirty_vars, self._itr = {"x"}, None
            self._make_dense = self._make_sparse = False
            self._depends_on_deps: dict[str, Any] = {}

    Ch.__module__, Ch.__qualname__ = "chumpy.ch", "Ch"
    modules = {"chumpy": ModuleType("chumpy"), "chumpy.ch": ModuleType("chumpy.ch")}
    modules["chumpy.ch"].Ch = Ch  # type: ignore[attr-defined]
    sys.modules.update(modules)
    try:
        yield Ch
    finally:
        for name in modules:
            del sys.modules[name]


def python_2(value: Any) -> bytes:
    """A pickle with the names that Python 2, and the numpy and scipy of its time, wrote."""
    data = pickle.dumps(value, 2)
    for new, old in PYTHON_2:
        data = data.replace(b"c" + new, b"c" + old)
    return data


def saved_object(value: Any) -> bytes:
    """What `np.save` writes of a dict: an .npy whose one entry is an object."""
    file = io.BytesIO()
    np.save(file, np.array(value, dtype=object), allow_pickle=True)
    return file.getvalue()
