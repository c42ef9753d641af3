"""The state of a run in `state.pt`, from which it resumes exactly.

Random draws depend on the seed and the step alone, so the state holds no generator.
"""

import json
import math
import pickle
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from facerf_cli.errors import FacerfError, InputError, UsageError
from facerf_cli.files.atomic import atomic_path
from facerf_cli.training.settings import MAY_CHANGE, Adadelta, AdamW, TrainSettings

_FORMAT = "facerf-state-1"


@dataclass
class State:
    """A run between two steps."""

    networks: nn.ModuleDict
    optimizer: torch.optim.Optimizer
    average: list[Tensor]  # of the networks' float tensors, in order; empty without ema_decay
    step: int = 0  # steps done
    seconds: float = 0.0  # duration of these steps, over all resumptions
    best: float = math.inf  # lowest validation metric so far
    start: dict[str, Any] = field(default_factory=dict)  # metadata of the checkpoint of --start-from
    provenance: dict[str, Any] = field(default_factory=dict)  # of the training data


def begin(
    networks: nn.ModuleDict, settings: TrainSettings, start: dict[str, Any], provenance: dict[str, Any]
) -> State:
    """Make the state before the first step."""
    optimizer = build_optimizer(settings.optimizer, networks.parameters())
    average = [tensor.clone() for tensor in _floats(networks)] if settings.ema_decay else []
    return State(networks, optimizer, average, start=start, provenance=provenance)


def build_optimizer(settings: AdamW | Adadelta, parameters: Iterable[nn.Parameter]) -> torch.optim.Optimizer:
    """Make the optimizer of some weights."""
    if isinstance(settings, Adadelta):
        return torch.optim.Adadelta(parameters, lr=settings.learning_rate, rho=settings.rho, eps=settings.eps)
    return torch.optim.AdamW(
        parameters, lr=settings.learning_rate, betas=settings.betas, weight_decay=settings.weight_decay
    )


@torch.no_grad()
def update_average(state: State, decay: float, step: int) -> None:
    """Move the average toward the weights; faster in the first steps, to forget the initial weights."""
    now = min(decay, step / (step + 10))
    for mean, tensor in zip(state.average, _floats(state.networks), strict=bool(state.average)):
        mean.lerp_(tensor, 1 - now)


@contextmanager
def averaged(state: State) -> Iterator[None]:
    """Give the networks their averaged weights within the block, to validate and save them."""
    kept = [tensor.clone() for tensor in _floats(state.networks)] if state.average else []
    _copy(state.average, state.networks)
    try:
        yield
    finally:
        _copy(kept, state.networks)


def save_state(path: Path, state: State, settings: TrainSettings) -> None:
    """Write the state, whole or not at all."""
    content = {
        "format": _FORMAT,
        "networks": state.networks.state_dict(),
        "optimizer": state.optimizer.state_dict(),
        "average": state.average,
        "step": state.step,
        "seconds": state.seconds,
        "best": state.best,
        "start": json.dumps(state.start),
        "provenance": json.dumps(state.provenance),
        "settings": json.dumps(asdict(settings)),
    }
    with atomic_path(path) as temporary:
        torch.save(content, temporary)


def load_state(path: Path, state: State, settings: TrainSettings) -> None:
    """Load what `save_state` wrote; raise UsageError where the run began with other settings or data."""
    try:
        content = torch.load(path, map_location="cpu", weights_only=True)
        if content["format"] != _FORMAT:
            raise ValueError("another version's file")
        _refuse_other_settings(path, json.loads(content["settings"]), settings)
        if json.loads(content["provenance"]) != json.loads(json.dumps(state.provenance)):
            raise UsageError(f"{path.parent}: the run began with other data; resume it with the same options")
        state.networks.load_state_dict(content["networks"])
        state.optimizer.load_state_dict(content["optimizer"])
        for mean, saved in zip(state.average, content["average"], strict=True):
            mean.copy_(saved)
        state.step, state.seconds, state.best = content["step"], content["seconds"], content["best"]
        state.start = json.loads(content["start"])
    except FacerfError:
        raise
    except (pickle.UnpicklingError, EOFError, KeyError, RuntimeError, TypeError, ValueError) as error:
        words = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise InputError(
            f"{path}: cannot be resumed ({words}); start another run with --start-from last.safetensors"
        ) from None


def _refuse_other_settings(path: Path, before: dict[str, Any], settings: TrainSettings) -> None:
    now = json.loads(json.dumps(asdict(settings)))
    other = [name for name in now if name not in MAY_CHANGE and now[name] != before.get(name)]
    if other:
        was = ", ".join(f"{name} {before.get(name)}" for name in other)
        raise UsageError(f"{path.parent}: the run began with {was}; resume it with the same options")


def _floats(networks: nn.ModuleDict) -> list[Tensor]:
    return [tensor for tensor in networks.state_dict().values() if tensor.is_floating_point()]


@torch.no_grad()
def _copy(values: list[Tensor], networks: nn.ModuleDict) -> None:
    for tensor, value in zip(_floats(networks), values, strict=bool(values)):
        tensor.copy_(value)
