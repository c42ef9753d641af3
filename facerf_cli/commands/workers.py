"""Items in parallel processes, for `--jobs`."""

import logging
import logging.handlers
import multiprocessing
import os
import signal
import sys
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from typing import Any, TypeVar

from facerf_cli.records import LOGGER_NAME

T = TypeVar("T")
R = TypeVar("R")


def in_processes(
    work: Callable[[T], R],
    items: Sequence[T],
    jobs: int,
    broken: Callable[[T, Exception], R],
) -> Iterator[R]:
    """Results in the items' order. The workers log through this process; Ctrl-C here ends them."""
    spawn = multiprocessing.get_context("spawn")  # torch does not survive a fork once its threads run
    records: Any = spawn.Queue()
    listener = logging.handlers.QueueListener(records, *logging.getLogger(LOGGER_NAME).handlers)
    listener.start()
    threads = max(1, (os.cpu_count() or 1) // jobs)
    level = logging.getLogger(LOGGER_NAME).level
    pool = ProcessPoolExecutor(jobs, spawn, initializer=_start_worker, initargs=(records, level, threads))
    try:
        futures = [pool.submit(_unless_terminated, work, item) for item in items]
        for item, future in zip(items, futures, strict=True):
            try:
                yield future.result()
            except BrokenProcessPool as error:
                yield broken(item, error)
    except BaseException:
        for process in multiprocessing.active_children():
            process.terminate()
        raise
    finally:
        pool.shutdown(wait=True, cancel_futures=True)
        listener.stop()


def _unless_terminated(work: Callable[[T], R], item: T) -> R:
    """The work on an item; a terminated worker ends here, for the pool would hand it the next item."""
    try:
        return work(item)
    except SystemExit:
        os._exit(143)


def _start_worker(records: Any, level: int, threads: int) -> None:
    """Runs first in each worker, before torch is imported: threads shared out, log to the parent."""
    os.environ.setdefault("OMP_NUM_THREADS", str(threads))
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))  # unwinds, so that temporary files go
    logger = logging.getLogger(LOGGER_NAME)
    logger.handlers[:] = [logging.handlers.QueueHandler(records)]
    logger.propagate = False
    logger.setLevel(level)
