"""Arrays and stand-ins that `inert_pickle` builds from a pickle without running it."""

from dataclasses import dataclass, field
from typing import Any

import numpy as np

_MAX_DIMENSIONS = 8  # of an array
_MAX_DENSE = 4 << 20  # entries of a sparse matrix; FLAME's joints are 5 x 5023
# Number types that are read; without objects, text and records.
_NUMBERS = frozenset({"f2", "f4", "f8", "b1", *(f"{kind}{size}" for kind in "iu" for size in (1, 2, 4, 8))})


class Refused(Exception):
    """The pickle contains something that is not read; the text says what."""


@dataclass(eq=False)
class StandIn:
    """An object of a pickle, not created: its class's name, its constructor's arguments and its state."""

    name: str
    arguments: tuple[Any, ...] = ()
    state: Any = None
    items: list[Any] = field(default_factory=list)


@dataclass(eq=False)
class InertDtype:
    """The number type of an array, in numpy's notation."""

    code: str  # such as f8
    order: str = "="


@dataclass(eq=False)
class InertArray:
    """An array whose values the pickle sets later; a list if its type is 'object'."""

    values: Any = None


def array_of(value: Any) -> np.ndarray:
    """Return the numbers in a value of an inert pickle; ValueError if there are none.

    A chumpy object gives its `x`, and a scipy.sparse matrix of at most `_MAX_DENSE` entries a dense array.
    """
    if isinstance(value, StandIn) and isinstance(value.state, dict):
        if "indptr" in value.state:
            return _dense(value)
        if value.name == "chumpy.ch.Ch":
            value = value.state.get("x")
    if isinstance(value, InertArray):
        value = value.values
    if isinstance(value, np.ndarray):
        return value
    if isinstance(value, list) and value and all(isinstance(entry, (int, float)) for entry in value):
        return np.array(value)
    name = value.name if isinstance(value, StandIn) else type(value).__name__
    raise ValueError(f"a {name} stands where numbers should be")


def _dense(matrix: StandIn) -> np.ndarray:
    """Return a compressed sparse matrix as a dense array; check its indices, which scipy does not."""
    data, indices, starts = (
        require(require(matrix.state.get(key), InertArray).values, np.ndarray)
        for key in ("data", "indices", "indptr")
    )
    rows, columns = require(matrix.state.get("_shape", matrix.state.get("shape")), tuple)
    by_column = "csc" in matrix.name
    lines, length = (columns, rows) if by_column else (rows, columns)
    is_consistent = (
        0 < require(lines, int) * require(length, int) <= _MAX_DENSE
        and starts.shape == (lines + 1,)
        and (starts[0], starts[-1]) == (0, len(data))
        and len(indices) == len(data)
        and bool((np.diff(starts) >= 0).all() and ((indices >= 0) & (indices < length)).all())
    )
    if not is_consistent:
        raise ValueError("a sparse matrix is damaged")
    dense = np.zeros((lines, length))
    np.add.at(dense, (np.repeat(np.arange(lines), np.diff(starts)), indices.astype(np.int64)), data)
    return dense.T if by_column else dense


def array_over(data: bytes, dtype: InertDtype, shape: Any, fortran: bool) -> np.ndarray:
    """Return a read-only view of the pickle's bytes; no memory is allocated for a size that a file claims."""
    if dtype.code not in _NUMBERS or dtype.order not in "<>|=":
        raise Refused(f"contains an array of type {dtype.code[:20]}")
    kind = np.dtype(dtype.code).newbyteorder(dtype.order)  # type: ignore[arg-type]
    lengths = tuple(require(length, int) for length in require(shape, tuple))
    count = 1
    for length in lengths:
        count *= length
        if length < 0 or count * kind.itemsize > len(data):
            raise Refused("contains an array that is larger than its data")
    if len(lengths) > _MAX_DIMENSIONS or count * kind.itemsize != len(data):
        raise Refused("contains an array that does not fit its data")
    return np.ndarray(lengths, kind, data, order="F" if fortran else "C")


def require(value: Any, kind: Any) -> Any:
    """Return the value if it has the given type; otherwise raise a ValueError."""
    if not isinstance(value, kind):
        raise ValueError(f"a {type(value).__name__} in the wrong place")
    return value


def text_of(value: Any) -> str:
    """Return a text, which pickles of Python 2 may store as bytes."""
    return value.decode("latin-1") if isinstance(value, bytes) else str(require(value, str))
