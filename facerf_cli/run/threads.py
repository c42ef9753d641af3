"""Work of one process in several threads, each of which computes alone.

Threads that share every single operation wait for each other thousands of times an image, and longest where
other programs run. Here each does whole pieces of the work, so that results do not depend on their number.
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
_set: list[int] = []  # the number of threads, once an operation takes one alone
_here = threading.local()


def compute_apart() -> None:
    """Let every operation of torch take one thread from now on, and `in_threads` as many as torch had."""
    _set[:] = _set or [torch.get_num_threads()]
    torch.set_num_threads(1)


def count() -> int:
    """Threads that `in_threads` has here: one in a thread of its own."""
    if getattr(_here, "is_one_of_them", False):
        return 1
    return _set[0] if _set else torch.get_num_threads()


def in_threads(function: Callable[[T], R], items: Iterable[T], most: int | None = None) -> Iterator[R]:
    """Yield a function's results in order, made in `count` threads, or in `most`; few wait to be used."""
    threads, together, graded = (
        min(count(), most or count()),
        torch.get_num_threads(),
        torch.is_grad_enabled(),
    )
    if threads == 1:
        yield from map(function, items)
        return

    def made(item: T) -> R:
        with torch.set_grad_enabled(graded):  # which each thread has for itself
            return function(item)

    coming: deque[Future[R]] = deque()
    try:
        with ThreadPoolExecutor(threads, initializer=_begin) as pool:
            for item in items:
                coming.append(pool.submit(made, item))
                if len(coming) > threads:
                    yield coming.popleft().result()
            while coming:
                yield coming.popleft().result()
    finally:
        torch.set_num_threads(together)  # for threads to come, too


def _begin() -> None:
    torch.set_num_threads(1)
    _here.is_one_of_them = True


def both(first: Callable[[], T], second: Callable[[], R]) -> tuple[T, R]:
    """Results of two functions, neither of which waits for the other; see `in_threads`."""
    functions: tuple[Callable[[], Any], ...] = (first, second)
    one, two = in_threads(lambda function: function(), functions)
    return cast(T, one), cast(R, two)


def one_ahead(items: Iterator[T]) -> Iterator[T]:
    """Yield items, of which the next one is made in a thread while one is used."""
    threads = torch.get_num_threads()
    with ThreadPoolExecutor(1, initializer=torch.set_num_threads, initargs=(threads,)) as thread:
        coming = thread.submit(list, islice(items, 1))
        while found := coming.result():
            coming = thread.submit(list, islice(items, 1))
            yield found[0]
