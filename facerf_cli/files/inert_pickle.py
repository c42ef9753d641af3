"""Pickles read without running any code: an interpreter that builds only arrays and inert stand-ins.

`pickle.load` calls any function that a file names. Here no name is imported or called: each must be in
`_ALLOWED`, and a call becomes a number, an array over the file's own bytes, or a `StandIn` that stores the
arguments. FLAME's pickles, which contain chumpy and scipy.sparse objects, therefore open without these
packages, and a hostile pickle is refused. The opcodes are those of the standard library's `pickletools`;
pickles of Python 2 are read too.
"""

import io
import pickletools
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

from facerf_cli.errors import InputError
from facerf_cli.files.inert_arrays import (
    InertArray,
    InertDtype,
    Refused,
    StandIn,
    array_over,
    require,
    text_of,
)
from facerf_cli.logs import one_line

_MAX_BYTES = 512 << 20  # of a file
_MAX_OPCODES = 200_000  # FLAME has a few thousand
_MAX_ENCODED = 512 << 20  # bytes decoded from text in total; a short text may be decoded many times
_PLAIN_KEYS = (str, bytes, int, float, bool, type(None))  # dict keys; a deep tuple's hash recurses

# Functions with a known result: numpy's constructors, and encodings of bytes.
_RECONSTRUCT = ("numpy.core.multiarray._reconstruct", "numpy._core.multiarray._reconstruct")
_FROM_BUFFER = ("numpy.core.numeric._frombuffer", "numpy._core.numeric._frombuffer")
_SCALAR = ("numpy.core.multiarray.scalar", "numpy._core.multiarray.scalar")
_DTYPE = ("numpy.dtype",)
_ENCODE = ("_codecs.encode",)
_BYTES = ("__builtin__.bytes",)  # without arguments: empty data
_BARE = ("copy_reg._reconstructor", "copyreg._reconstructor")  # arguments: class, base, state of the base
# Classes whose objects become stand-ins.
_CLASSES = (
    *("numpy.ndarray", "__builtin__.object", "builtins.object", "__builtin__.set", "builtins.set"),
    *("collections.OrderedDict", "torch._utils._rebuild_tensor_v2"),
    *("torch.storage._load_from_bytes", "torch.FloatStorage", "torch.LongStorage", "torch.DoubleStorage"),
    *(f"scipy.sparse.{module}.{kind}_matrix" for kind in ("csc", "csr") for module in (kind, f"_{kind}")),
    *(f"scipy.sparse._{kind}.{kind}_array" for kind in ("csc", "csr")),
)
# Names that begin with chumpy. are allowed too; chumpy's operations become stand-ins, which do nothing.
_ALLOWED = frozenset((*_RECONSTRUCT, *_FROM_BUFFER, *_SCALAR, *_DTYPE, *_ENCODE, *_BYTES, *_BARE, *_CLASSES))


@dataclass(frozen=True)
class _Name:
    """A name that the pickle wants to import: module and attribute joined by a dot."""

    text: str


def read_inert_pickle(path: Path) -> Any:
    """Read a .pkl of dicts, lists, tuples, text, numbers, and the stand-ins of `inert_arrays`.

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
    machine = _Machine()
    try:
        for opcode, argument, _ in pickletools.genops(io.BytesIO(file.read(_MAX_BYTES))):
            machine.step(opcode.name, argument)
        return _unwrapped(machine.pop())
    except Refused as refused:
        raise InputError(f"{path}: refused: it {refused}; nothing of it was run") from None
    except (ValueError, IndexError, KeyError, TypeError, OverflowError, EOFError, MemoryError) as error:
        raise InputError(
            f"{path}: not a readable pickle ({one_line(str(error))[:120]}); get the file again"
        ) from None


def _unwrapped(value: Any) -> Any:
    """Return the only object of an array of objects, which is how numpy saves one object."""
    if isinstance(value, InertArray) and isinstance(value.values, list) and len(value.values) == 1:
        return value.values[0]
    return value


class _Machine:
    """The stack machine of pickles; its memo stores objects by number."""

    def __init__(self) -> None:
        self._stack: list[Any] = []
        self._marks: list[int] = []
        self._memo: dict[int, Any] = {}
        self._steps = 0
        self._encoded = 0

    def step(self, opcode: str, argument: Any) -> None:
        """Execute one opcode."""
        self._steps += 1
        if self._steps > _MAX_OPCODES:
            raise Refused(f"has more than {_MAX_OPCODES} instructions")
        if opcode in _CONSTANTS:
            self._stack.append(_CONSTANTS[opcode])
        elif opcode in _LITERALS:
            self._stack.append(argument)
        elif opcode in _OPCODES:
            _OPCODES[opcode](self, argument)
        elif opcode not in _IDLE:
            raise Refused(f"uses the instruction {opcode}, which no array needs")

    def pop(self) -> Any:
        """Remove and return the top of the stack."""
        if self._marks and self._marks[-1] == len(self._stack):
            raise ValueError("a mark instead of a value")
        return self._stack.pop()

    def _drop(self, _: Any) -> None:
        self.pop()

    def _drop_marked(self, _: Any) -> None:
        self._marked()

    def _marked(self) -> list[Any]:
        at = self._marks.pop()
        taken = self._stack[at:]
        del self._stack[at:]
        return taken

    def _mark(self, _: Any) -> None:
        self._marks.append(len(self._stack))

    def _new(self, value: Any) -> None:
        self._stack.append(value)

    def _tuple(self, count: int) -> None:
        taken = [self.pop() for _ in range(count)]
        self._stack.append(tuple(reversed(taken)))

    def _dup(self, _: Any) -> None:
        self._stack.append(self._stack[-1])

    def _put(self, number: Any) -> None:
        self._memo[len(self._memo) if number is None else int(number)] = self._stack[-1]

    def _get(self, number: Any) -> None:
        self._stack.append(self._memo[int(number)])

    def _append(self, values: list[Any]) -> None:
        target = self._stack[-1]
        (target.items if isinstance(target, StandIn) else require(target, list)).extend(values)

    def _set_items(self, pairs: list[Any]) -> None:
        target = self._stack[-1]
        for key, value in zip(pairs[::2], pairs[1::2], strict=True):
            if isinstance(target, StandIn):
                target.items.append((key, value))
            elif isinstance(key, _PLAIN_KEYS):
                require(target, dict)[key] = value
            else:
                raise Refused("has a key that is neither text nor a number")

    def _name(self, text: str) -> None:
        name = ".".join(text.split(" "))
        if name not in _ALLOWED and not name.startswith("chumpy."):
            raise Refused(f"names {name[:80]}, which is not part of a face model")
        self._stack.append(_Name(name))

    def _stack_name(self, _: Any) -> None:
        name, module = self.pop(), self.pop()
        self._name(f"{require(module, str)} {require(name, str)}")

    def _reduce(self, _: Any) -> None:
        arguments = require(self.pop(), tuple)
        self._stack.append(self._called(require(self.pop(), _Name).text, arguments))

    def _called(self, name: str, arguments: tuple[Any, ...]) -> Any:
        """Return the substitute for a call's result; nothing is called."""
        if name in _ENCODE:
            text, encoding = arguments
            if encoding not in ("latin1", "latin-1"):
                raise Refused("encodes text in a way that no array needs")
            return self._bytes(require(text, str))
        if name in _BYTES and not arguments:
            return b""
        if name in _RECONSTRUCT:
            return InertArray()
        if name in _DTYPE:
            return InertDtype(text_of(arguments[0]))
        if name in _FROM_BUFFER:
            raw, dtype, shape, order = arguments
            return InertArray(array_over(self._bytes(raw), require(dtype, InertDtype), shape, order == "F"))
        if name in _SCALAR:
            return array_over(self._bytes(arguments[1]), require(arguments[0], InertDtype), (), False).item()
        if name in _BARE:
            return StandIn(require(arguments[0], _Name).text)
        return StandIn(name, arguments)

    def _bytes(self, raw: Any) -> bytes:
        if isinstance(raw, bytes):
            return raw
        self._encoded += len(require(raw, (str, bytearray)))
        if self._encoded > _MAX_ENCODED:
            raise Refused("makes more bytes of text than a face model has")
        return raw.encode("latin-1") if isinstance(raw, str) else bytes(raw)

    def _build(self, _: Any) -> None:
        state, target = self.pop(), self._stack[-1]
        if isinstance(target, InertArray):
            _, shape, dtype, fortran, raw = require(state, tuple)
            is_list = require(dtype, InertDtype).code in ("O", "O8")
            target.values = (
                require(raw, list) if is_list else array_over(self._bytes(raw), dtype, shape, bool(fortran))
            )
        elif isinstance(target, InertDtype):
            target.order = text_of(require(state, tuple)[1])
        else:
            require(target, StandIn).state = state


_CONSTANTS = {"NONE": None, "NEWTRUE": True, "NEWFALSE": False}
_LITERALS = frozenset(
    {
        *("INT", "BININT", "BININT1", "BININT2", "LONG", "LONG1", "LONG4", "FLOAT", "BINFLOAT"),
        *("STRING", "BINSTRING", "SHORT_BINSTRING", "UNICODE", "BINUNICODE", "SHORT_BINUNICODE"),
        *("BINUNICODE8", "BINBYTES", "SHORT_BINBYTES", "BINBYTES8", "BYTEARRAY8"),
    }
)
_IDLE = frozenset({"PROTO", "FRAME", "STOP"})
_OPCODES: dict[str, Callable[[_Machine, Any], None]] = {
    "MARK": _Machine._mark,
    "POP": _Machine._drop,
    "POP_MARK": _Machine._drop_marked,
    "DUP": _Machine._dup,
    "EMPTY_TUPLE": lambda machine, _: machine._tuple(0),
    "TUPLE1": lambda machine, _: machine._tuple(1),
    "TUPLE2": lambda machine, _: machine._tuple(2),
    "TUPLE3": lambda machine, _: machine._tuple(3),
    "TUPLE": lambda machine, _: machine._new(tuple(machine._marked())),
    "EMPTY_LIST": lambda machine, _: machine._new([]),
    "EMPTY_SET": lambda machine, _: machine._new(StandIn("builtins.set")),
    "LIST": lambda machine, _: machine._new(machine._marked()),
    "APPEND": lambda machine, _: machine._append([machine.pop()]),
    "APPENDS": lambda machine, _: machine._append(machine._marked()),
    "ADDITEMS": lambda machine, _: machine._append(machine._marked()),
    "EMPTY_DICT": lambda machine, _: machine._new({}),
    "DICT": lambda machine, _: _dict(machine),
    "SETITEM": lambda machine, _: _set_item(machine),
    "SETITEMS": lambda machine, _: machine._set_items(machine._marked()),
    **dict.fromkeys(("PUT", "BINPUT", "LONG_BINPUT", "MEMOIZE"), _Machine._put),
    **dict.fromkeys(("GET", "BINGET", "LONG_BINGET"), _Machine._get),
    "GLOBAL": _Machine._name,
    "STACK_GLOBAL": _Machine._stack_name,
    "REDUCE": _Machine._reduce,
    "NEWOBJ": _Machine._reduce,  # creates an object without a state, as a call does
    "BUILD": _Machine._build,
}


def _set_item(machine: _Machine) -> None:
    value, key = machine.pop(), machine.pop()
    machine._set_items([key, value])


def _dict(machine: _Machine) -> None:
    pairs = machine._marked()
    machine._new({})
    machine._set_items(pairs)
