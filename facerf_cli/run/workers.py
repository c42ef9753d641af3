"""Process items one after another, in processes of this machine (`--jobs`), or as tasks of Ray (`--ray`).

A process that is killed costs its own item; in joblib's and the standard library's pools all that run.
"""

import logging
import os
import signal
import threading
from collections import deque
from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import closing, contextmanager, suppress
from dataclasses import dataclass
from typing import Any, TypeVar

from facerf_cli.errors import FacerfError
from facerf_cli.run.logs import LOGGER_NAME, log_to_queue
from facerf_cli.run.machine import processors
from facerf_cli.run.stopping import end_on_signals, leave

T = TypeVar("T")
R = TypeVar("R")
_PATIENCE_S = 1.0  # for a worker to unwind after SIGTERM


@dataclass
class _Worker:
    """A process, our end of the pipe to it, and its item."""

    process: Any
    pipe: Any
    row: deque[int]  # numbers of the items that it takes next
    number: int | None = None  # of the item that it processes
    started: bool = False


def in_processes(
    work: Callable[[T], R],
    items: Sequence[T],
    jobs: int,
    broken: Callable[[T, Exception], R],
    in_a_row: int = 1,
) -> Generator[tuple[int, R]]:
    """Yield results as they come; a process that dies costs its own item, and another one replaces it.

    A process takes so many neighbouring items `in_a_row`, one after the other.

    Each process has its own pipe: a lock or a queue that processes share could stay locked by a killed one.
    """
    from multiprocessing.connection import wait  # --help does without it

    numbers = range(len(items))
    waiting = deque(deque(numbers[first : first + in_a_row]) for first in numbers[::in_a_row])
    workers: dict[Any, _Worker] = {}
    try:
        for _ in range(min(jobs, len(waiting))):
            _start_worker(workers, jobs)
        while workers:
            for pipe in wait(list(workers)):
                worker = workers[pipe]
                number = worker.number
                kind, content = _receive(worker)
                if kind == "record":
                    logging.getLogger(LOGGER_NAME).handle(content)
                elif kind == "raised":
                    raise content
                elif kind == "died":
                    del workers[pipe]
                    if worker.row:
                        waiting.appendleft(worker.row)
                    if number is not None:
                        if waiting:
                            _start_worker(workers, jobs)
                        yield number, broken(items[number], content)
                else:  # "ready", or a "result"
                    _send_next(worker, work, items, waiting)
                    if number is not None:
                        yield number, content
    finally:
        _end_workers(list(workers.values()))


def _start_worker(workers: dict[Any, _Worker], jobs: int) -> None:
    """Start one more process; it sends "ready" when it can receive the work and items."""
    import multiprocessing

    spawn = multiprocessing.get_context("spawn")  # torch does not survive a fork once its threads run
    ours, theirs = spawn.Pipe()
    level = logging.getLogger(LOGGER_NAME).level
    threads = max(1, processors() // jobs)
    process = spawn.Process(target=_serve, args=(theirs, level, threads))
    process.start()
    theirs.close()  # so that the worker holds the only other end, and its death closes the pipe
    workers[ours] = _Worker(process, ours, deque())


def _receive(worker: _Worker) -> tuple[str, Any]:
    """Receive a worker's message, or notice that it died."""
    try:
        kind, content = worker.pipe.recv()
    except (EOFError, OSError):
        worker.process.join()
        worker.pipe.close()
        if worker.number is None and not worker.started:
            raise FacerfError(
                f"a worker process could not start ({_cause_of_death(worker)}); try --jobs 1"
            ) from None
        return "died", ChildProcessError(_cause_of_death(worker))
    return kind, content


def _cause_of_death(worker: _Worker) -> str:
    code = worker.process.exitcode
    return f"exit code {code}" if code >= 0 else f"killed by {signal.Signals(-code).name}"


def _send_next(
    worker: _Worker, work: Callable[[T], R], items: Sequence[T], waiting: deque[deque[int]]
) -> None:
    """Send a worker the next item, or None at the end."""
    with suppress(BrokenPipeError, ConnectionResetError):  # it died; `_receive` notices
        if not worker.started:
            worker.pipe.send(work)
            worker.started = True
        if not worker.row and waiting:
            worker.row = waiting.popleft()
        worker.number = worker.row.popleft() if worker.row else None
        worker.pipe.send(None if worker.number is None else (items[worker.number],))


def _end_workers(workers: Sequence[_Worker]) -> None:
    """End processes by SIGTERM, which lets them remove temporary files, then by SIGKILL."""
    for worker in workers:
        worker.process.terminate()
    for worker in workers:
        worker.process.join(1.5 * _PATIENCE_S)
        worker.process.kill()
        worker.process.join()
        worker.pipe.close()


def _serve(pipe: Any, level: int, threads: int) -> None:
    """Run a worker process: a result for each item, until None. Imports torch only after this call."""
    os.environ.setdefault("OMP_NUM_THREADS", str(threads))
    for number in ("SIGINT", "SIGHUP"):  # a terminal sends them to all; our parent ends us
        if hasattr(signal, number):
            signal.signal(getattr(signal, number), signal.SIG_IGN)
    end_on_signals(_PATIENCE_S, interrupts=False)
    wire = _Wire(pipe)
    log_to_queue(wire, level)
    try:
        with suppress(EOFError, BrokenPipeError):  # the parent has ended
            wire.send("ready", None)
            work = pipe.recv()
            while (wrapped := pipe.recv()) is not None:
                try:
                    wire.send("result", work(wrapped[0]))
                except Exception as error:
                    wire.send("raised", error)
        leave(0)
    except SystemExit as stop:  # of a signal
        leave(stop.code if isinstance(stop.code, int) else 1)


class _Wire:
    """A worker's end of the pipe, locked between its threads."""

    def __init__(self, pipe: Any) -> None:
        self._pipe, self._lock = pipe, threading.Lock()

    def send(self, kind: str, content: Any) -> None:
        with self._lock:
            self._pipe.send((kind, content))

    def put_nowait(self, record: logging.LogRecord) -> None:
        """Send a log record; called by a `QueueHandler`."""
        self.send("record", record)


@dataclass(frozen=True)
class Workers:
    """The choice of workers: `jobs` processes of this machine, or tasks of Ray.

    With Ray, `jobs` tasks run at a time (0: as many as Ray has processors), each with `gpus` GPUs (None: with
    one where the cluster has any).
    """

    jobs: int = 1
    ray: str | None = None  # address; None: this machine, without Ray
    gpus: int | None = 0
    in_a_row: int = 1  # neighbouring items that a process of this machine takes one after the other


def spread(
    work: Callable[[T], R],
    items: Sequence[T],
    workers: Workers,
    broken: Callable[[T, Exception], R],
) -> Iterator[R]:
    """Yield `work(item)` of each item in the items' order, computed by the workers.

    `broken` gives the result of an item whose worker died while it had it. Workers log through this process;
    Ctrl-C ends them, if it ends what is returned (`ending`). An exception of `work` is raised there.
    """
    if workers.ray is not None and items:
        from facerf_cli.run.ray_workers import in_ray

        return in_order(in_ray(work, items, workers.ray, workers.jobs, workers.gpus, broken))
    if workers.jobs > 1 and len(items) > 1:
        return in_order(in_processes(work, items, workers.jobs, broken, workers.in_a_row))
    return map(work, items)


@contextmanager
def ending(results: Iterator[R]) -> Iterator[Iterator[R]]:
    """End the workers of `spread` at the end of the block."""
    try:
        yield results
    finally:
        if isinstance(results, Generator):
            results.close()


def process_died(error: Exception) -> str:
    """Say that an item's process died, and what to do."""
    return f"its process died, perhaps for want of memory; try fewer --jobs ({error})"


def in_order(results: Generator[tuple[int, R]]) -> Generator[R]:
    """Sort results, numbered from 0, into the order of their numbers."""
    early: dict[int, R] = {}
    following = 0
    with closing(results):
        for number, result in results:
            early[number] = result
            while following in early:
                yield early.pop(following)
                following += 1


def in_shards(work: Callable[[list[T]], None], items: list[T], jobs: int) -> None:
    """Call `work` (picklable) in `jobs` processes, each on every jobs-th item.

    The first error, Ctrl-C or SIGTERM ends all of them and is raised; FacerfError where a process dies.
    """
    shards = [items[job::jobs] for job in range(min(jobs, len(items)))]
    with closing(in_processes(work, shards, len(shards), _lost_shard)) as results:
        for _ in results:
            pass


def _lost_shard(items: list[T], error: Exception) -> None:
    raise FacerfError(process_died(error))


@contextmanager
def one_thread() -> Iterator[None]:
    """Let torch compute on one thread within the block, so that sums are the same on every machine."""
    import torch

    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)
