"""Work spread over processes, a share of the items each."""

from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import active_children, get_context
from typing import TypeVar

Item = TypeVar("Item")


def in_shards(work: Callable[[list[Item]], None], items: list[Item], jobs: int) -> None:
    """Call `work` (picklable) in each of `jobs` processes, on every jobs-th item.

    The first error, Ctrl-C or SIGTERM ends them all, and is raised.
    """
    if not items:
        return
    pool = ProcessPoolExecutor(jobs, mp_context=get_context("spawn"))
    try:
        for done in [pool.submit(work, items[job::jobs]) for job in range(jobs)]:
            done.result()
    except BaseException:
        for process in active_children():
            process.terminate()
        raise
    finally:
        pool.shutdown(wait=True, cancel_futures=True)
