"""What the bar of a run says of its time."""

from typing import Any

import pytest

from facerf_cli.batch.settings import Settings
from facerf_cli.work.train import TrainProgress


def row(step: int, seconds: float) -> dict[str, Any]:
    return {"step": step, "seconds": seconds, "loss": 1.0, "terms": {"root": 1.0}, "waiting": 0.0}


def shown(
    steps: int | None, max_seconds: float | None, rows: list[dict[str, Any]]
) -> tuple[float, bool, str]:
    """How far the bar is, whether it takes the run for over, and the time left."""
    progress = TrainProgress(steps, max_seconds, Settings(), shown=False)
    for one in rows:
        progress.row(one)
    (task,) = progress.bar.tasks
    return task.completed, task.finished, task.fields["left"]


def test_the_first_step_does_not_end_a_run_of_steps() -> None:
    assert shown(100, None, [row(1, 0.5)]) == (0.0, False, "")


def test_the_time_left_is_by_the_pace_of_this_leg() -> None:
    done, finished, left = shown(100, None, [row(50, 400.0), row(51, 401.0), row(60, 410.0)])
    assert done == pytest.approx(410 / 450) and not finished and left == "0:00:40 left"


def test_the_time_left_is_by_the_clock_where_that_ends_first() -> None:
    rows = [row(1, 1.0), row(2, 2.0)]
    assert shown(10_000, 60.0, rows)[2] == "0:00:58 left"
    assert shown(10, 3600.0, rows)[2] == "0:00:08 left"
    assert shown(None, 60.0, rows[:1])[2] == "0:00:59 left"


def test_the_last_step_ends_it() -> None:
    assert shown(3, None, [row(1, 1.0), row(3, 3.0)])[:2] == (1.0, True)
