"""Threads that each compute alone: in order, not inside each other, and no matter how many."""

import threading
import time
from collections.abc import Iterator

import pytest
import torch

from facerf_cli.run import threads as module
from facerf_cli.run.threads import both, count, in_threads, one_ahead
from tests.refusals import refused


@pytest.fixture(autouse=True)
def _three(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    before = torch.get_num_threads()
    monkeypatch.setattr(module, "_set", [])
    torch.set_num_threads(3)
    yield
    torch.set_num_threads(before)


def test_results_come_in_order_from_threads_that_each_compute_alone() -> None:
    meeting = threading.Barrier(3, timeout=10)

    def work(number: int) -> tuple[int, int, int, bool]:
        meeting.wait()  # of all three at the same time
        with torch.no_grad():
            inside = list(in_threads(lambda one: threading.get_ident(), range(5)))
        assert set(inside) == {threading.get_ident()}
        return number, count(), torch.get_num_threads(), torch.is_grad_enabled()

    with torch.no_grad():
        assert list(in_threads(work, range(6))) == [(number, 1, 1, False) for number in range(6)]
    assert count() == torch.get_num_threads() == 3


def test_few_results_wait_and_operations_take_one_thread() -> None:
    made: list[int] = []

    def work(number: int) -> int:
        made.append(number)
        return 1 // (5 - number)

    found = in_threads(work, iter(range(100)))
    assert next(found) == 0 and max(made) < 5
    with pytest.raises(ZeroDivisionError):
        list(found)
    module.compute_apart()
    module.compute_apart()
    assert torch.get_num_threads() == 1 and count() == 3
    assert both(threading.get_ident, lambda: "two")[1] == "two"
    assert torch.get_num_threads() == 1


def test_one_is_made_ahead_in_order_and_its_error_comes_in_its_place() -> None:
    made: list[int] = []

    def numbers() -> Iterator[int]:
        for number in range(3):
            made.append(number)
            yield number
        raise ValueError("the fourth")

    ahead = one_ahead(numbers())
    assert made == [] and next(ahead) == 0
    while len(made) < 2:  # nobody asked for it yet
        time.sleep(0.001)
    assert next(ahead) == 1 and next(ahead) == 2
    refused(ValueError, "the fourth", next, ahead)
