"""Write the log of a run: log.jsonl, validation-*.png and, if installed, TensorBoard; and note its signals.

Ctrl-C and SIGTERM end a run between two steps, so that nothing is lost; a second one ends it at once.
"""

import logging
import math
import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from facerf_cli.errors import UsageError
from facerf_cli.files.atomic import atomic_path
from facerf_cli.files.texts import parse_json
from facerf_cli.files.write import write_display
from facerf_cli.image.colour import linear_to_srgb
from facerf_cli.run.logs import LOGGER_NAME, json_line
from facerf_cli.run.stopping import unhurried

LOG = "log.jsonl"
_SIGNALS = (signal.SIGINT, signal.SIGTERM)
log = logging.getLogger(LOGGER_NAME)


def refuse_another_run(folder: Path) -> None:
    """Raise UsageError if a folder already contains a run, which training would overwrite."""
    if any((folder / name).exists() for name in ("state.pt", LOG, "last.safetensors")):
        raise UsageError(f"{folder}: already contains a run; pass --resume, or choose another folder")


class RunLog:
    """Write log.jsonl and TensorBoard events; rows after `step`, which a killed run leaves, are removed."""

    def __init__(self, folder: Path, step: int) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        self.folder = folder
        path = folder / LOG
        if path.exists():
            rows = [line for line in path.read_text().splitlines() if _step_of(line) <= step]
            with atomic_path(path) as temporary:
                temporary.write_text("".join(f"{line}\n" for line in rows))
        self.file = path.open("a")
        self.board: Any = None
        try:
            from torch.utils.tensorboard import SummaryWriter

            self.board = SummaryWriter(folder / "tensorboard", purge_step=step + 1)
        except ImportError:
            words = (
                "TensorBoard is not installed (pip install 'facerf[tensorboard]'); the log is in log.jsonl"
            )
            log.info(words)

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
        for name, value in row.items() if self.board else ():
            numbers = value if isinstance(value, dict) else {"": value}
            for inner, number in numbers.items() if name != "step" else ():
                self.board.add_scalar(f"{name}/{inner}".rstrip("/"), number, row["step"])

    def sheet(self, step: int, sheet: np.ndarray) -> None:
        """Write a contact sheet [H, W, 3], scene-linear."""
        path = self.folder / f"validation-{step:07d}.png"
        write_display(path, sheet.astype(np.float32), exposure=1.0)  # EV
        if self.board:
            self.board.add_image("sheet", linear_to_srgb(sheet.clip(0, 1)), step, dataformats="HWC")


def _step_of(line: str) -> float:
    """Return the step of a row; infinity for an incomplete line."""
    try:
        return float(parse_json(line)["step"])
    except (ValueError, KeyError, TypeError):
        return math.inf


@dataclass
class Stop:
    """Signal that asked the run to end; 0 for none."""

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
