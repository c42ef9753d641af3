"""Work of one process in several threads, each of which computes alone.

If all threads shared every operation, they would wait for each other thousands of times per image, and
longest beside other programs. Here each thread does complete pieces of work, so that results do not depend on
the number of threads.
"""

import threading
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from itertools import islice
from typing import Any, TypeVar, cast

import torch

T = TypeVar("T")
R = TypeVar("R")
_set: list[int] = []  # the number of threads, once every operation takes one
_here = threading.local()


def compute_apart() -> None:
    """Limit every operation of torch to one thread, and let `in_threads` use as many as torch had."""
    _set[:] = _set or [torch.get_num_threads()]
    torch.set_num_threads(1)


def count() -> int:
    """Return the number of threads of `in_threads`: one if called in such a thread."""
    if getattr(_here, "is_one_of_them", False):
        return 1
    return _set[0] if _set else torch.get_num_threads()


def in_threads(function: Callable[[T], R], items: Iterable[T], most: int | None = None) -> Iterator[R]:
    """Yield a function's results in order, computed in `count` threads, or `most`; few results wait."""
    threads = min(count(), most or count())
    if threads == 1:
        yield from map(function, items)
        return
    shared_threads, has_gradients = torch.get_num_threads(), torch.is_grad_enabled()

    def begin() -> None:
        torch.set_num_threads(1)
        torch.set_grad_enabled(has_gradients)  # each thread has its own setting
        _here.is_one_of_them = True

    coming: deque[Future[R]] = deque()
    try:
        with ThreadPoolExecutor(threads, initializer=begin) as pool:
            for item in items:
                coming.append(pool.submit(function, item))
                if len(coming) > threads:
                    yield coming.popleft().result()
            while coming:
                yield coming.popleft().result()
    finally:
        torch.set_num_threads(shared_threads)  # the default of threads that start later


def both(first: Callable[[], T], second: Callable[[], R]) -> tuple[T, R]:
    """Return the results of two independent functions; see `in_threads`."""
    functions: tuple[Callable[[], Any], ...] = (first, second)
    one, two = in_threads(lambda function: function(), functions)
    return cast(T, one), cast(R, two)


def one_ahead(items: Iterator[T]) -> Iterator[T]:
    """Yield items; a thread computes the next one while one is used."""
    threads = torch.get_num_threads()
    with ThreadPoolExecutor(1, initializer=torch.set_num_threads, initargs=(threads,)) as thread:
        coming = thread.submit(list, islice(items, 1))
        while items_made := coming.result():
            coming = thread.submit(list, islice(items, 1))
            yield items_made[0]
