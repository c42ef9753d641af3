"""Progress of a training run: a bar on a terminal, otherwise a log line a validation."""

import logging
from typing import Any

from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

from facerf_cli.batch.settings import Settings
from facerf_cli.run.logs import LOGGER_NAME, STDERR

_SMOOTH = 0.95  # of the moving average of the losses
log = logging.getLogger(LOGGER_NAME)


class TrainProgress:
    """Step, losses, last validation, share of time spent waiting for batches, and the time left."""

    def __init__(self, steps: int | None, max_seconds: float | None, settings: Settings, shown: bool) -> None:
        columns = (
            TextColumn("{task.description}"),
            BarColumn(bar_width=20),
            TimeElapsedColumn(),
            TextColumn("{task.fields[left]}"),
        )
        self.on = shown and STDERR.is_terminal and settings.verbosity >= 0 and not settings.log_json
        self.steps, self.max_seconds = steps, max_seconds
        self.bar = Progress(*columns, console=STDERR, disable=not self.on)
        self.task = self.bar.add_task("training", total=1.0, left="")
        self.smooth: dict[str, float] = {}
        self.validation = ""
        self.begun: tuple[int, float] | None = None

    def __enter__(self) -> "TrainProgress":
        self.bar.start()
        return self

    def __exit__(self, *_: Any) -> None:
        self.bar.stop()

    def row(self, row: dict[str, Any]) -> None:
        """Show one row of the log."""
        losses = {"loss": row["loss"], **(row["terms"] if len(row["terms"]) > 1 else {})}
        for name, value in losses.items():
            self.smooth[name] = _SMOOTH * self.smooth.get(name, value) + (1 - _SMOOTH) * value
        words = "  ".join(f"{name} {value:.4g}" for name, value in self.smooth.items())
        if "validation" in row:
            self.validation = "  ".join(f"{name} {value:.4g}" for name, value in row["validation"].items())
            if not self.on:
                log.info("step %d  %s  |  %s", row["step"], words, self.validation)
        text = f"step {row['step']}  {words}  waiting {100 * row['waiting']:.0f} %"
        text += f"  |  {self.validation}" if self.validation else ""
        left_s = self._left_s(row)
        done = 0.0 if left_s is None else row["seconds"] / max(row["seconds"] + left_s, 1e-9)
        left = "" if left_s is None else f"{_clock(left_s)} left"
        self.bar.update(self.task, completed=done, description=text, left=left)

    def _left_s(self, row: dict[str, Any]) -> float | None:
        """Seconds left by this process's pace or by --max-time, whichever ends first; None while unknown."""
        self.begun = self.begun or (row["step"], row["seconds"])
        steps = row["step"] - self.begun[0]
        left = []
        if self.max_seconds:
            left.append(self.max_seconds - row["seconds"])
        if self.steps and steps:
            left.append((self.steps - row["step"]) * (row["seconds"] - self.begun[1]) / steps)
        return max(0.0, min(left)) if left else None


def _clock(seconds: float) -> str:
    minutes = int(seconds) // 60
    return f"{minutes // 60}:{minutes % 60:02d}:{int(seconds) % 60:02d}"
