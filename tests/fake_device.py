"""A device that computes on the CPU and refuses operators that mix devices, as CUDA does.

Its tensors report the device `meta`, which code that asks `tensor.device` passes on.
"""

import traceback
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass
from typing import Any
from unittest.mock import patch

import torch
from torch import Tensor, nn
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_flatten, tree_map

DEVICE = torch.device("meta")


@dataclass
class Calls:
    """The number of operators that ran on the device."""

    count: int = 0


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
        return _computed(Calls(), function, args, kwargs or {})

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
def in_use() -> Iterator[Calls]:
    """Refuse operators that mix devices; create new tensors on the fake device where they ask for it."""
    calls = Calls()
    make, make_like = torch.tensor, Tensor.new_tensor

    def sent(made: Tensor, device: Any) -> Tensor:
        return made if device is None or torch.device(device) != DEVICE else OnDevice(made)

    def tensor(data: Any, *, device: Any = None, **settings: Any) -> Tensor:
        return sent(make(data, **settings), device)

    def new_tensor(self: Tensor, data: Any, **settings: Any) -> Tensor:
        return sent(make_like(torch.empty(0, dtype=self.dtype), data, **settings), self.device)

    # autocast does not know the device
    plain = patch("torch.autocast", lambda *arguments, **settings: nullcontext())
    with (
        _Refusing(calls),
        patch("torch.tensor", tensor),
        plain,
        patch("torch.Tensor.new_tensor", new_tensor),
    ):
        yield calls


class _Refusing(TorchDispatchMode):
    def __init__(self, calls: Calls) -> None:
        super().__init__()
        self.calls = calls

    def __torch_dispatch__(self, function: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        kwargs = kwargs or {}
        if torch.is_inference_mode_enabled():  # in which operators are not taken apart before they come here
            with self:
                found = function.decompose(*args, **kwargs)
            if found is not NotImplemented:
                return found
        return _computed(self.calls, function, args, kwargs)


def _computed(calls: Calls, function: Any, args: Any, kwargs: dict[str, Any]) -> Any:
    given = [value for value in tree_flatten((args, kwargs))[0] if isinstance(value, Tensor)]
    there = [value for value in given if isinstance(value, OnDevice)]
    here = [value for value in given if not isinstance(value, OnDevice)]
    name, asked = function._schema.name.removeprefix("aten::"), kwargs.get("device")
    asked = None if asked is None else torch.device(asked)
    if asked == DEVICE:
        kwargs = kwargs | {"device": torch.device("cpu")}
    copies = "_to_copy" in name or name == "copy_"
    if there and not (copies and here and (asked == DEVICE or name == "copy_")):
        calls.count += 1
        for value in here:
            if value.dim() and not (name.startswith("index") and value.dtype in (torch.int64, torch.bool)):
                raise RuntimeError(f"{name} mixes devices at {_line()}")
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
