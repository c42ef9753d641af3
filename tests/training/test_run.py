"""What the bar of a run says of its time."""

from dataclasses import replace
from typing import Any

import pytest

from facerf_cli.batch.settings import Settings
from facerf_cli.training.run import TrainProgress
from facerf_cli.training.settings import PRESETS


def row(step: int, seconds: float) -> dict[str, Any]:
    return {"step": step, "seconds": seconds, "loss": 1.0, "terms": {"root": 1.0}, "waiting": 0.0}


@pytest.mark.parametrize(
    ("steps", "max_seconds", "done"),
    [(100, None, 0.6), (10_000, 60.0, 0.5), (60, 3600.0, 1.0), (None, 60.0, 0.5)],
)
def test_the_bar_is_as_far_as_the_run(steps: int | None, max_seconds: float | None, done: float) -> None:
    training = replace(PRESETS["default"], steps=steps, max_seconds=max_seconds)
    progress = TrainProgress(training, Settings(), shown=False)
    progress.row(row(60, 30.0))
    (task,) = progress.bar.tasks
    assert task.completed == pytest.approx(done) and task.finished == (done == 1)
