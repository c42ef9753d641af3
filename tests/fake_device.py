"""A device that computes on the CPU and counts what a GPU would wait for.

Its tensors say that they are on the device `meta`, which code that asks `tensor.device` passes on. Within
`counted()` an operator that mixes them with tensors of the CPU is refused, as CUDA would, and copies and
waits are counted by the line of facerf that asks for them.
"""

import traceback
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass, field
from typing import Any
from unittest.mock import patch

import torch
from torch import Tensor, nn
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_flatten, tree_map

DEVICE = torch.device("meta")
# Operators whose result the host must know before it goes on.
_WAITS = ("_local_scalar_dense", "nonzero", "_unique2", "unique_dim", "repeat_interleave")


@dataclass
class Counts:
    """How often a step calls the device, waits for it and copies to it; by lines of facerf."""

    calls: int = 0
    waits: Counter[str] = field(default_factory=Counter)
    copies: Counter[str] = field(default_factory=Counter)


class OnDevice(Tensor):
    """A tensor on the fake device, and its values."""

    values: Tensor

    @staticmethod
    def __new__(cls, values: Tensor) -> "OnDevice":
        with torch.inference_mode(False):  # a tensor of that mode could not be detached
            made = torch.Tensor._make_wrapper_subclass(  # type: ignore[attr-defined]
                cls,
                values.size(),
                strides=values.stride(),
                storage_offset=values.storage_offset(),
                dtype=values.dtype,
                device=DEVICE,
            )
        made.values = values
        return made  # type: ignore[no-any-return]

    @classmethod
    def __torch_dispatch__(cls, function: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        return _computed(Counts(), function, args, kwargs or {})

    def __getitem__(self, key: Any) -> Any:
        return super().__getitem__(_index(key))

    def __setitem__(self, key: Any, value: Any) -> None:
        super().__setitem__(_index(key), value)


def _index(key: Any) -> Any:
    """An index whose lists and ranges are tensors: torch would make them without values, on meta."""
    if isinstance(key, tuple):
        return tuple(map(_index, key))
    return torch.as_tensor(list(key)) if isinstance(key, list | range) else key


def moved(module: nn.Module) -> nn.Module:
    """The module with its parameters and buffers on the fake device."""
    for part in module.modules():
        for name, value in list(part._parameters.items()):
            if value is not None:
                held = OnDevice(value.detach().clone())
                part._parameters[name] = nn.Parameter(held, requires_grad=value.requires_grad)
        for name, buffer in list(part._buffers.items()):
            part._buffers[name] = None if buffer is None else OnDevice(buffer.clone())
    return module


@contextmanager
def counted() -> Iterator[Counts]:
    """Count what is done on the fake device; new tensors that ask for it are on it."""
    counts = Counts()
    make, make_like = torch.tensor, Tensor.new_tensor

    def sent(made: Tensor, device: Any) -> Tensor:
        if device is None or torch.device(device) != DEVICE:
            return made
        counts.copies[_line()] += 1
        return OnDevice(made)

    def tensor(data: Any, *, device: Any = None, **settings: Any) -> Tensor:
        return sent(make(data, **settings), device)

    def new_tensor(self: Tensor, data: Any, **settings: Any) -> Tensor:
        return sent(make_like(torch.empty(0, dtype=self.dtype), data, **settings), self.device)

    # autocast does not know the device
    plain = patch("torch.autocast", lambda *arguments, **settings: nullcontext())
    with (
        _Counting(counts),
        patch("torch.tensor", tensor),
        plain,
        patch("torch.Tensor.new_tensor", new_tensor),
    ):
        yield counts


class _Counting(TorchDispatchMode):
    def __init__(self, counts: Counts) -> None:
        super().__init__()
        self.counts = counts

    def __torch_dispatch__(self, function: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        kwargs = kwargs or {}
        if torch.is_inference_mode_enabled():  # in which operators are not taken apart before they come here
            with self:
                found = function.decompose(*args, **kwargs)
            if found is not NotImplemented:
                return found
        return _computed(self.counts, function, args, kwargs)


def _computed(counts: Counts, function: Any, args: Any, kwargs: dict[str, Any]) -> Any:
    given = [value for value in tree_flatten((args, kwargs))[0] if isinstance(value, Tensor)]
    there = [value for value in given if isinstance(value, OnDevice)]
    here = [value for value in given if not isinstance(value, OnDevice)]
    name, asked = function._schema.name.removeprefix("aten::"), kwargs.get("device")
    asked = None if asked is None else torch.device(asked)
    if asked == DEVICE:
        kwargs = kwargs | {"device": torch.device("cpu")}
    copies = "_to_copy" in name or name == "copy_"
    if copies and here and (asked == DEVICE or (there and name == "copy_")):
        counts.copies[_line()] += 1
    elif there:
        counts.calls += 1
        if name in _WAITS and (name != "repeat_interleave" or kwargs.get("output_size") is None):
            counts.waits[_line()] += 1
        if copies and asked is not None and asked != DEVICE:
            counts.waits[_line()] += 1
        for value in here:
            if value.dim() and not (name.startswith("index") and value.dtype in (torch.int64, torch.bool)):
                raise RuntimeError(f"{name} mixes devices at {_line()}")
            if value.dim():
                counts.copies[_line()] += 1  # of an index
    found = function(*tree_map(_value, args), **tree_map(_value, kwargs))
    if name == "copy_" or (there and name.endswith("_") and not name.endswith("__")):
        return args[0]
    if copies:
        return (
            found if asked not in (None, DEVICE) or (asked is None and not there) else tree_map(_held, found)
        )
    return tree_map(_held, found) if there or asked == DEVICE else found


def _value(value: Any) -> Any:
    return value.values if isinstance(value, OnDevice) else value


def _held(value: Any) -> Any:
    return OnDevice(value) if isinstance(value, Tensor) and not isinstance(value, OnDevice) else value


def _line() -> str:
    """The line of facerf that runs."""
    for frame in reversed(traceback.extract_stack(limit=60)):
        if "/facerf_cli/" in frame.filename:
            return f"{frame.filename.split('/facerf_cli/')[1]}:{frame.lineno} {frame.line}"
    return "elsewhere"
