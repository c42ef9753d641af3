"""Pickles read without running any code of theirs: Python's unpickler with names from an allow-list.

Each name that a pickle imports becomes a class of stand-ins, which only store what they are given; `array_of`
then reads the numbers of an array of numpy, chumpy or scipy.sparse over the file's own bytes. FLAME's pickles
therefore open without these packages, and a hostile pickle is refused.
"""

import io
import pickle
import pickletools
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from facerf_cli.errors import InputError
from facerf_cli.run.logs import one_line

_MAX_BYTES = 512 << 20  # of a file
_MAX_OPCODES = 200_000  # FLAME has a few thousand
_MAX_TUPLES = 5000  # nested ones recurse where they are keys
_MAX_DIMENSIONS = 8  # of an array
_MAX_DENSE = 4 << 20  # entries of a sparse matrix; FLAME's joints are 5 x 5023
# Number types that are read; without objects, text and records.
_NUMBERS = frozenset({"f2", "f4", "f8", "b1", *(f"{kind}{size}" for kind in "iu" for size in (1, 2, 4, 8))})

_FROM_BUFFER = ("numpy.core.numeric._frombuffer", "numpy._core.numeric._frombuffer")
_SCALAR = ("numpy.core.multiarray.scalar", "numpy._core.multiarray.scalar")
_BARE = ("copy_reg._reconstructor", "copyreg._reconstructor")  # arguments: class, base, state of the base
# Names that begin with chumpy. are allowed, too.
_ALLOWED = frozenset(
    (
        *("numpy.core.multiarray._reconstruct", "numpy._core.multiarray._reconstruct", "numpy.dtype"),
        *(*_FROM_BUFFER, *_SCALAR, *_BARE, "numpy.ndarray", "_codecs.encode", "__builtin__.bytes"),
        *("__builtin__.object", "builtins.object", "__builtin__.set", "builtins.set"),
        *("collections.OrderedDict", "torch._utils._rebuild_tensor_v2"),
        *("torch.storage._load_from_bytes", "torch.FloatStorage", "torch.LongStorage", "torch.DoubleStorage"),
        *(f"scipy.sparse.{module}.{kind}_matrix" for kind in ("csc", "csr") for module in (kind, f"_{kind}")),
        *(f"scipy.sparse._{kind}.{kind}_array" for kind in ("csc", "csr")),
    )
)


class _Unreadable(Exception):
    """The pickle contains something that is not read; the text says what."""


class StandIn:
    """An object of a pickle, not created: its class's name, its constructor's arguments and its state."""

    name = ""
    arguments: tuple[Any, ...]
    state: Any = None

    def __new__(cls, *arguments: Any) -> "StandIn":  # noqa: D102  # some opcodes call it alone
        made = super().__new__(cls)
        made.arguments = arguments
        return made

    def __setstate__(self, state: Any) -> None:
        self.state = state

    def __setitem__(self, key: Any, value: Any) -> None:
        """Leave out an entry of a class of dicts."""

    def append(self, value: Any) -> None:
        """Leave out an entry of a class of lists."""


class _Unpickler(pickle.Unpickler):
    def find_class(self, module: str, name: str) -> type[StandIn]:
        """Return a class of stand-ins for an allowed name."""
        whole = f"{module}.{name}"
        if whole not in _ALLOWED and not whole.startswith("chumpy."):
            raise _Unreadable(f"names {whole[:80]}, which is not part of a face model")
        return type("StandIn", (StandIn,), {"name": whole})


def read_inert_pickle(path: Path) -> Any:
    """Read a .pkl of dicts, lists, tuples, text, numbers, and stand-ins.

    No code of the file runs. A damaged file, and one that names anything other than arrays of numpy, chumpy
    and scipy.sparse, raises an InputError.
    """
    if not path.is_file():
        raise InputError(f"{path}: no such file; give a face model's .pkl")
    if path.stat().st_size > _MAX_BYTES:
        raise InputError(f"{path}: too large for a face model ({_MAX_BYTES >> 20} MiB at most)")
    with path.open("rb") as file:
        return read_inert_stream(file, path)


def read_inert_stream(file: BinaryIO, path: Path) -> Any:
    """Read the pickle that begins at an open file's position; errors name `path`."""
    content = file.read(_MAX_BYTES)
    try:
        _check_work(content)
        return _unwrapped(_Unpickler(io.BytesIO(content), encoding="latin-1").load())
    except _Unreadable as refused:
        raise InputError(f"{path}: refused: it {refused}; nothing of it was run") from None
    except Exception as error:  # whatever damage makes an unpickler raise
        raise InputError(
            f"{path}: not a readable pickle ({one_line(str(error))[:120]}); get the file again"
        ) from None


def _check_work(content: bytes) -> None:
    """Refuse a pickle of too many instructions, and one that would make the unpickler take much memory."""
    tuples = 0
    for count, (opcode, argument, _) in enumerate(pickletools.genops(content), 1):
        tuples += opcode.name.startswith(("TUPLE", "FROZENSET"))
        if count > _MAX_OPCODES or tuples > _MAX_TUPLES:
            raise _Unreadable(f"has more than {_MAX_OPCODES} instructions, or {_MAX_TUPLES} tuples")
        if "PUT" in opcode.name and int(argument or 0) > _MAX_OPCODES:
            raise _Unreadable(f"numbers an object {argument}")


def _unwrapped(value: Any) -> Any:
    """Return the only object of an array of objects, which is how numpy saves one object."""
    match value:
        case StandIn(state=(_, _, StandIn(arguments=("O8" | "O", *_)), _, [entry])):
            return entry
    return value


def array_of(value: Any) -> np.ndarray:
    """Return the numbers in a value of an inert pickle; ValueError if there are none.

    A chumpy object gives its `x`, and a scipy.sparse matrix of at most `_MAX_DENSE` entries a dense array.
    """
    if isinstance(value, StandIn) and isinstance(value.state, dict):
        if "indptr" in value.state:
            return _dense(value)
        if _class_name(value) == "chumpy.ch.Ch":
            value = value.state.get("x")
    return _numbers(value)


def _numbers(value: Any) -> np.ndarray:
    """Return the numbers in an array of numpy, a scalar of it, or a list."""
    match value:
        case np.ndarray():
            return value
        case StandIn(state=(_, shape, dtype, fortran, raw)):
            return _array_over(_bytes(raw), dtype, shape, bool(fortran))
        case StandIn(name=name, arguments=(raw, dtype, shape, order)) if name in _FROM_BUFFER:
            return _array_over(_bytes(raw), dtype, shape, order == "F")
        case StandIn(name=name, arguments=(dtype, raw)) if name in _SCALAR:
            return _array_over(_bytes(raw), dtype, (), False)
        case [*entries] if entries and all(isinstance(entry, (int, float)) for entry in entries):
            return np.array(entries)
    name = _class_name(value) if isinstance(value, StandIn) else type(value).__name__
    raise ValueError(f"a {name} stands where numbers should be")


def _class_name(value: StandIn) -> str:
    """Return the name of the class that a stand-in is of."""
    if value.name in _BARE and value.arguments and isinstance(value.arguments[0], type):
        return str(getattr(value.arguments[0], "name", ""))
    return value.name


def _dense(matrix: StandIn) -> np.ndarray:
    """Return a compressed sparse matrix as a dense array; check its indices, which scipy does not."""
    state = _require(matrix.state, dict)
    data, indices, starts = (_numbers(state.get(key)) for key in ("data", "indices", "indptr"))
    rows, columns = _require(state.get("_shape", state.get("shape")), tuple)
    by_column = "csc" in _class_name(matrix)
    lines, length = (columns, rows) if by_column else (rows, columns)
    is_consistent = (
        0 < _require(lines, int) * _require(length, int) <= _MAX_DENSE
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


def _array_over(data: bytes, dtype: Any, shape: Any, fortran: bool) -> np.ndarray:
    """Return a read-only view of the pickle's bytes; no memory is allocated for a size that a file claims."""
    code = str(_require(dtype, StandIn).arguments[0])
    order = str(dtype.state[1]) if isinstance(dtype.state, tuple) else "="
    if code not in _NUMBERS or order not in "<>|=":
        raise ValueError(f"it contains an array of type {code[:20]}")
    kind = np.dtype(code).newbyteorder(order)  # type: ignore[arg-type]
    lengths = tuple(_require(length, int) for length in _require(shape, tuple))
    count = 1
    for length in lengths:
        count *= length
        if length < 0 or count * kind.itemsize > len(data):
            raise ValueError("it contains an array that is larger than its data")
    if len(lengths) > _MAX_DIMENSIONS or count * kind.itemsize != len(data):
        raise ValueError("it contains an array that does not fit its data")
    return np.ndarray(lengths, kind, data, order="F" if fortran else "C")


def _bytes(raw: Any) -> bytes:
    """Return the bytes of an array, which pickles of Python 2 may store as text."""
    match raw:
        case StandIn(name="_codecs.encode", arguments=(str(text), "latin1" | "latin-1")):
            return text.encode("latin-1")
        case StandIn(name="__builtin__.bytes", arguments=()):
            return b""
        case str():
            return raw.encode("latin-1")
    return bytes(_require(raw, (bytes, bytearray)))


def _require(value: Any, kind: Any) -> Any:
    """Return the value if it has the given type; otherwise raise a ValueError."""
    if not isinstance(value, kind):
        raise ValueError(f"a {type(value).__name__} in the wrong place")
    return value
