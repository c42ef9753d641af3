"""Work spread over processes, a share of the items each."""

from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from typing import TypeVar

Item = TypeVar("Item")


def in_shards(work: Callable[[list[Item]], None], items: list[Item], jobs: int) -> None:
    """Call `work` (picklable) in each of `jobs` processes, on every jobs-th item; raise the first error."""
    if not items:
        return
    with ProcessPoolExecutor(jobs, mp_context=get_context("spawn")) as pool:
        for done in [pool.submit(work, items[job::jobs]) for job in range(jobs)]:
            done.result()
