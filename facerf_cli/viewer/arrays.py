"""Named arrays packed for a page: quantized, deflated and in base64, with a directory of them."""

import base64
import zlib
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
from torch import Tensor

Kind = Literal["half", "byte", "short", "index"]
_LEVELS = {"byte": (255, np.dtype("<u1")), "short": (65535, np.dtype("<u2"))}
_DEFLATE_LEVEL = 9


@dataclass(eq=False)
class ArrayPack:
    """Arrays in the order in which they were added.

    "half" keeps 11 bits of a number; "byte" and "short" are steps between the least and the largest value of
    each plane, the first axis; "index" is a whole number of 16 bits, stored as its difference from the one
    before.
    """

    directory: dict[str, dict[str, Any]] = field(default_factory=dict)
    parts: list[bytes] = field(default_factory=list)
    length: int = 0

    def add(self, name: str, values: np.ndarray | Tensor, kind: Kind) -> None:
        """Add an array [C, ...]."""
        array = values.numpy() if isinstance(values, Tensor) else values
        entry: dict[str, Any] = {"kind": kind, "shape": list(array.shape), "at": self.length}
        if kind == "half":
            data = _in_planes(array.astype("<f2"))
        elif kind == "index":
            steps = np.diff(array.ravel().astype("<u2"), prepend=np.uint16(0))
            data = _in_planes(steps.astype("<u2"))
        else:
            levels, dtype = _LEVELS[kind]
            flat = array.reshape(len(array), -1).astype(np.float64)
            low, high = flat.min(1, keepdims=True), flat.max(1, keepdims=True)
            step = np.maximum(high - low, 1e-12) / levels
            entry |= {"low": low[:, 0].tolist(), "step": step[:, 0].tolist()}
            data = _in_planes(np.round((flat - low) / step).astype(dtype))
        self.directory[name] = entry
        self.parts.append(data)
        self.length += len(data)

    def document(self) -> dict[str, Any]:
        """The arrays for a page's JSON."""
        packed = zlib.compress(b"".join(self.parts), _DEFLATE_LEVEL)
        return {"arrays": self.directory, "bytes": base64.b64encode(packed).decode("ascii")}


def _in_planes(array: np.ndarray) -> bytes:
    """The bytes of an array, the low ones of all numbers before the high ones: they compress better."""
    raw = np.frombuffer(array.tobytes(), np.uint8).reshape(-1, array.dtype.itemsize)
    return raw.T.tobytes()
