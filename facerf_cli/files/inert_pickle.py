"""Pickles read without running any code of theirs: Python's unpickler with names from an allow-list.

Each name that a pickle imports becomes a class of stand-ins, which only store what they are given; `array_of`
then reads the numbers of an array of numpy, chumpy or scipy.sparse over the file's own bytes. FLAME's pickles
therefore open without chumpy, and a hostile pickle is refused.
"""

import io
import pickle
import pickletools
import re
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from scipy import sparse

from facerf_cli.errors import InputError
from facerf_cli.files.texts import require_regular
from facerf_cli.run.logs import one_line

_MAX_BYTES = 512 << 20  # of a file
_MAX_OPCODES = 200_000  # FLAME has a few thousand
_MAX_TUPLES = 5000  # nested ones recurse where they are keys
_MAX_DENSE = 4 << 20  # entries of a sparse matrix; FLAME's joints are 5 x 5023
_NUMBERS = re.compile(r"f[248]|[iu][1248]|b1")  # types that are read: no objects, text or records
_ALLOWED = re.compile(
    r"numpy\.(_?core\.multiarray\.(_reconstruct|scalar)|_?core\.numeric\._frombuffer|dtype|ndarray)"
    r"|(copy_reg|copyreg)\._reconstructor|_codecs\.encode|__builtin__\.(bytes|object|set)"
    r"|builtins\.(object|set)|collections\.OrderedDict|torch\._utils\._rebuild_tensor_v2"
    r"|torch\.storage\._load_from_bytes|torch\.(Float|Long|Double)Storage"
    r"|scipy\.sparse\._?(csc|csr)\.(csc|csr)_(matrix|array)|chumpy\..*"
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
        if not _ALLOWED.fullmatch(whole):
            raise _Unreadable(f"names {whole[:80]}, which is not part of a face model")
        return type("StandIn", (StandIn,), {"name": whole})


def read_inert_pickle(path: Path) -> Any:
    """Read a .pkl of dicts, lists, tuples, text, numbers, and stand-ins.

    No code of the file runs. A damaged file, and one that names anything other than arrays of numpy, chumpy
    and scipy.sparse, raises an InputError.
    """
    require_regular(path, "give a face model's .pkl")
    with path.open("rb") as file:
        return read_inert_stream(file, path)


def read_inert_stream(file: BinaryIO, path: Path) -> Any:
    """Read the pickle that begins at an open file's position; errors name `path`."""
    content = file.read(_MAX_BYTES + 1)
    try:
        _check_work(content)
        value = _Unpickler(io.BytesIO(content), encoding="latin-1").load()
    except _Unreadable as refused:
        raise InputError(f"{path}: refused: it {refused}; nothing of it was run") from None
    except Exception as error:  # whatever damage makes an unpickler raise
        raise InputError(
            f"{path}: not a readable pickle ({one_line(str(error))[:120]}); get the file again"
        ) from None
    match value:
        case StandIn(state=(_, _, StandIn(arguments=("O8" | "O", *_)), _, [entry])):  # one object, by np.save
            return entry
    return value


def _check_work(content: bytes) -> None:
    """Refuse a pickle of too many instructions, and one that would make the unpickler take much memory."""
    if len(content) > _MAX_BYTES:
        raise _Unreadable(f"is too large for a face model ({_MAX_BYTES >> 20} MiB at most)")
    tuples = 0
    for count, (opcode, argument, _) in enumerate(pickletools.genops(content), 1):
        tuples += opcode.name.startswith(("TUPLE", "FROZENSET"))
        if count > _MAX_OPCODES or tuples > _MAX_TUPLES:
            raise _Unreadable(f"has more than {_MAX_OPCODES} instructions, or {_MAX_TUPLES} tuples")
        if "PUT" in opcode.name and int(argument or 0) > _MAX_OPCODES:
            raise _Unreadable(f"numbers an object {argument}")


def array_of(value: Any) -> np.ndarray:
    """Return the numbers in a value of an inert pickle; ValueError, TypeError or KeyError if there are none.

    A chumpy object gives its `x`, and a scipy.sparse matrix of at most `_MAX_DENSE` entries a dense array.
    """
    match value:
        case StandIn(state={"x": inner}) if _class_name(value) == "chumpy.ch.Ch":
            return _numbers(inner)
        case StandIn(state={"indptr": starts, "indices": indices, "data": data} as state):
            rows, columns = map(int, state["_shape"] if "_shape" in state else state["shape"])
            if not 0 < rows * columns <= _MAX_DENSE:
                raise ValueError("a sparse matrix is too large")
            kind = sparse.csc_matrix if "csc" in _class_name(value) else sparse.csr_matrix
            matrix = kind((_numbers(data), _numbers(indices), _numbers(starts)), (rows, columns))
            matrix.check_format(full_check=True)
            return np.asarray(matrix.toarray(), np.float64)
    return _numbers(value)


def _numbers(value: Any) -> np.ndarray:
    """Return the numbers in an array of numpy, a scalar of it, or a list."""
    name = _class_name(value)
    match value:
        case np.ndarray():
            return value
        case StandIn(state=(_, shape, dtype, fortran, raw)):
            return _array_over(raw, dtype, shape, "F" if fortran else "C")
        case StandIn(arguments=(raw, dtype, shape, order)) if name.endswith("._frombuffer"):
            return _array_over(raw, dtype, shape, order)
        case StandIn(arguments=(dtype, raw)) if name.endswith(".scalar"):
            return _array_over(raw, dtype, (), "C")
        case [*entries] if entries and all(isinstance(entry, (int, float)) for entry in entries):
            return np.array(entries)
    raise ValueError(f"a {name} stands where numbers should be")


def _class_name(value: Any) -> str:
    """Return the name of a value's class, or of the class that a stand-in is of."""
    match value:
        case StandIn(name="copy_reg._reconstructor" | "copyreg._reconstructor", arguments=(kind, *_)):
            return str(getattr(kind, "name", ""))
        case StandIn(name=name):
            return name
    return type(value).__name__


def _array_over(raw: Any, dtype: StandIn, shape: Any, order: Any) -> np.ndarray:
    """Return a read-only view of the pickle's bytes; no memory is allocated for a size that a file claims."""
    code = str(dtype.arguments[0])
    byte_order = str(dtype.state[1]) if isinstance(dtype.state, tuple) else "="
    if not _NUMBERS.fullmatch(code) or byte_order not in "<>|=":
        raise ValueError(f"it contains an array of type {code[:20]}")
    kind = np.dtype(code).newbyteorder(byte_order)  # type: ignore[arg-type]
    data, lengths = _bytes(raw), tuple(map(int, shape))
    try:
        array = np.ndarray(lengths, kind, data, order="F" if order == "F" else "C")
    except (ValueError, TypeError, OverflowError):  # it needs more bytes than there are
        array = None
    if array is None or array.nbytes != len(data) or min(lengths, default=0) < 0:
        raise ValueError("it contains an array that does not fit its data")
    return array


def _bytes(raw: Any) -> bytes:
    """Return the bytes of an array, which pickles of Python 2 may store as text."""
    match raw:
        case StandIn(name="_codecs.encode", arguments=(str(text), "latin1" | "latin-1")):
            return text.encode("latin-1")
        case StandIn(name="__builtin__.bytes", arguments=()):
            return b""
        case str():
            return raw.encode("latin-1")
        case bytes() | bytearray():
            return bytes(raw)
    raise ValueError("an array without its bytes")
