"""The folder of a run: log.jsonl, validation-*.png and, if installed, TensorBoard events; and its signals.

Ctrl-C and SIGTERM end a run between two steps, so that nothing is lost; a second one ends it at once.
"""

import json
import logging
import math
import pickle
import signal
import sys
import threading
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from facerf_cli.batch.recipe import Recipe, recipe_of, require_same
from facerf_cli.errors import FacerfError, InputError, UsageError
from facerf_cli.files.atomic import atomic_path
from facerf_cli.files.texts import file_sha256, parse_json
from facerf_cli.files.write import write_display
from facerf_cli.image.colour import linear_to_srgb
from facerf_cli.run.logs import LOGGER_NAME, json_line
from facerf_cli.run.stopping import unhurried
from facerf_cli.training.settings import Adadelta, AdamW, TrainSettings

LOG = "log.jsonl"
_SIGNALS = (signal.SIGINT, signal.SIGTERM)
log = logging.getLogger(LOGGER_NAME)


def refuse_another_run(folder: Path) -> None:
    """Raise UsageError where a folder holds a run already, which training would overwrite."""
    if any((folder / name).exists() for name in ("state.pt", LOG, "last.safetensors")):
        raise UsageError(f"{folder}: holds a run already; give --resume to continue it, or another folder")


class RunLog:
    """Writer of log.jsonl and TensorBoard; it removes rows after `step`, which a killed run leaves."""

    def __init__(self, folder: Path, step: int) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        self.folder = folder
        path = folder / LOG
        if path.exists():
            rows = [line for line in path.read_text().splitlines() if _step_of(line) <= step]
            with atomic_path(path) as temporary:
                temporary.write_text("".join(f"{line}\n" for line in rows))
        self.file = path.open("a")
        self.board = _tensorboard(folder / "tensorboard", step)

    def __enter__(self) -> "RunLog":
        return self

    def __exit__(self, *_: Any) -> None:
        self.file.close()
        if self.board:
            self.board.close()

    def write(self, row: dict[str, Any]) -> None:
        """Write a row; entries of its dictionaries are named OUTER/INNER in TensorBoard."""
        self.file.write(json_line(row) + "\n")
        self.file.flush()
        if self.board:
            for name, value in _flat(row).items():
                self.board.add_scalar(name, value, row["step"])

    def sheet(self, step: int, sheet: np.ndarray) -> None:
        """Write a contact sheet [H, W, 3], scene-linear."""
        path = self.folder / f"validation-{step:07d}.png"
        write_display(path, sheet.astype(np.float32), exposure=1.0)  # EV
        if self.board:
            self.board.add_image("sheet", linear_to_srgb(sheet.clip(0, 1)), step, dataformats="HWC")


def _step_of(line: str) -> float:
    """Step of a row; infinite for an incomplete line."""
    try:
        return float(parse_json(line)["step"])
    except (ValueError, KeyError, TypeError):
        return math.inf


def _flat(row: dict[str, Any]) -> dict[str, float]:
    flat: dict[str, float] = {}
    for name, value in row.items():
        if isinstance(value, dict):
            flat |= {f"{name}/{inner}": number for inner, number in value.items()}
        elif name != "step":
            flat[name] = value
    return flat


def _tensorboard(folder: Path, step: int) -> Any:
    try:
        from torch.utils.tensorboard import SummaryWriter
    except ImportError:
        log.info("TensorBoard is not installed (pip install 'facerf[tensorboard]'); the log is in log.jsonl")
        return None
    return SummaryWriter(folder, purge_step=step + 1)


@dataclass
class Stop:
    """The signal that asked the run to end; 0 for none."""

    signal: int = 0

    def leave(self) -> None:
        """End the process as the signal would have."""
        if self.signal == signal.SIGINT:
            raise KeyboardInterrupt
        if self.signal:
            sys.exit(128 + self.signal)


@contextmanager
def stop_on_signals() -> Iterator[Stop]:
    """Record signals instead of handling them within the block; only in the main thread."""
    stop = Stop()
    if threading.current_thread() is not threading.main_thread():
        yield stop
        return

    def note(number: int, _: Any) -> None:
        stop.signal = number
        for which, handler in before.items():
            signal.signal(which, handler)

    before = {which: signal.signal(which, note) for which in _SIGNALS}
    try:
        with unhurried():
            yield stop
    finally:
        for which, handler in before.items():
            signal.signal(which, handler)


_FORMAT = "facerf-state-2"


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
        "settings": json.dumps(_recipe(settings)),
    }
    with atomic_path(path) as temporary:
        torch.save(content, temporary)


def load_state(path: Path, state: State, settings: TrainSettings) -> None:
    """Load what `save_state` wrote; raise UsageError where the run began with other settings or data."""
    try:
        content = torch.load(path, map_location="cpu", weights_only=True)
        if content["format"] != _FORMAT:
            raise ValueError("another version's file")
        said, advice = f"{path.parent}: the run began otherwise", "resume it with the same options"
        require_same(json.loads(content["settings"]), _recipe(settings), said, advice)
        if content["provenance"] != json.dumps(state.provenance):
            raise UsageError(f"{path.parent}: the run began with other data; resume it with the same data")
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


def _recipe(settings: TrainSettings) -> Recipe:
    """The recipe of a run, by the names of options."""
    recipe = recipe_of(settings, file_sha256)
    del recipe["results"]  # of verbs that write images
    return {"optimizer": type(settings.optimizer).__name__, **recipe}


def _floats(networks: nn.ModuleDict) -> list[Tensor]:
    return [tensor for tensor in networks.state_dict().values() if tensor.is_floating_point()]


@torch.no_grad()
def _copy(values: list[Tensor], networks: nn.ModuleDict) -> None:
    for tensor, value in zip(_floats(networks), values, strict=bool(values)):
        tensor.copy_(value)
