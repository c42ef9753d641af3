"""Process items one after another, in processes of this machine (`--jobs`), or as tasks of Ray (`--ray`)."""

import logging
import multiprocessing
import os
import signal
import sys
import threading
from collections import deque
from collections.abc import Callable, Generator, Sequence
from contextlib import closing, suppress
from dataclasses import dataclass
from multiprocessing.connection import wait
from typing import Any, TypeVar

from facerf_cli.errors import FacerfError
from facerf_cli.logs import LOGGER_NAME, log_to_queue

T = TypeVar("T")
R = TypeVar("R")
_PATIENCE_S = 10  # for a worker that was asked to end


@dataclass
class _Worker:
    """A process, our end of the pipe to it, and what it has to do."""

    process: Any
    pipe: Any
    number: int | None = None  # of the item in its hands
    started: bool = False


def in_processes(
    work: Callable[[T], R], items: Sequence[T], jobs: int, broken: Callable[[T, Exception], R]
) -> Generator[tuple[int, R]]:
    """Results as they come; a process that dies costs its own item, and another takes its place.

    Each has a pipe of its own, for what processes share, a lock or a queue, a killed one may leave locked.
    """
    waiting = deque(range(len(items)))
    workers: dict[Any, _Worker] = {}
    try:
        for _ in range(min(jobs, len(items))):
            _hire(workers, jobs)
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
                    if number is not None:
                        if waiting:
                            _hire(workers, jobs)
                        yield number, broken(items[number], content)
                else:  # "ready", or a "result"
                    _hand_on(worker, work, items, waiting)
                    if number is not None:
                        yield number, content
    finally:
        _dismiss(list(workers.values()))


def _hire(workers: dict[Any, _Worker], jobs: int) -> None:
    """Start one more process; it says "ready" when it can be given the work, and then items."""
    spawn = multiprocessing.get_context("spawn")  # torch does not survive a fork once its threads run
    ours, theirs = spawn.Pipe()
    level = logging.getLogger(LOGGER_NAME).level
    threads = max(1, (os.cpu_count() or 1) // jobs)
    process = spawn.Process(target=_serve, args=(theirs, level, threads))
    process.start()
    theirs.close()  # so that theirs is the only one, and its end is the pipe's
    workers[ours] = _Worker(process, ours)


def _receive(worker: _Worker) -> tuple[str, Any]:
    """What a worker says, or that it died, and how."""
    try:
        kind, content = worker.pipe.recv()
    except (EOFError, OSError):
        worker.process.join()
        worker.pipe.close()
        if worker.number is None and not worker.started:
            raise FacerfError(f"a process could not start ({_how(worker)}); try --jobs 1") from None
        return "died", ChildProcessError(_how(worker))
    return kind, content


def _how(worker: _Worker) -> str:
    code = worker.process.exitcode
    return f"exit code {code}" if code >= 0 else f"killed by {signal.Signals(-code).name}"


def _hand_on(worker: _Worker, work: Callable[[T], R], items: Sequence[T], waiting: deque[int]) -> None:
    """Give a worker the next item, or word that there is none."""
    with suppress(BrokenPipeError, ConnectionResetError):  # it died; `_receive` finds out
        if not worker.started:
            worker.pipe.send(work)
            worker.started = True
        worker.number = waiting.popleft() if waiting else None
        worker.pipe.send(None if worker.number is None else (items[worker.number],))


def _dismiss(workers: Sequence[_Worker]) -> None:
    """End processes: by SIGTERM, which lets them take their temporary files away, and then by force."""
    for worker in workers:
        worker.process.terminate()
    for worker in workers:
        worker.process.join(_PATIENCE_S)
        worker.process.kill()
        worker.process.join()
        worker.pipe.close()


def _serve(pipe: Any, level: int, threads: int) -> None:
    """A worker process: results out for items in, until there is none. torch is not imported before this."""
    os.environ.setdefault("OMP_NUM_THREADS", str(threads))
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))  # unwinds, so that temporary files go
    wire = _Wire(pipe)
    log_to_queue(wire, level)
    with suppress(EOFError, BrokenPipeError):  # the parent is gone
        wire.send("ready", None)
        work = pipe.recv()
        while (wrapped := pipe.recv()) is not None:
            try:
                wire.send("result", work(wrapped[0]))
            except Exception as error:
                wire.send("raised", error)


class _Wire:
    """A worker's end of the pipe, on which its threads take turns."""

    def __init__(self, pipe: Any) -> None:
        self._pipe, self._lock = pipe, threading.Lock()

    def send(self, kind: str, content: Any) -> None:
        with self._lock:
            self._pipe.send((kind, content))

    def put_nowait(self, record: logging.LogRecord) -> None:
        """What a `QueueHandler` does with a record."""
        self.send("record", record)


@dataclass(frozen=True)
class Workers:
    """Where items are processed: `jobs` processes of this machine, or tasks of Ray.

    With Ray, `jobs` tasks run at a time (0: as many as Ray has processors), each with `gpus` GPUs.
    """

    jobs: int = 1
    ray: str | None = None  # address; None: this machine, without Ray
    gpus: int = 0


def spread(
    work: Callable[[T], R],
    items: Sequence[T],
    workers: Workers,
    broken: Callable[[T, Exception], R],
    recover: Callable[[T], R | None] = lambda item: None,
) -> Generator[R]:
    """Yield `work(item)` of each item in the items' order, computed by the workers.

    `broken` gives the result of an item whose worker died while it had it. Before an item is tried again,
    `recover` gives its result if the lost worker had finished it, else None. Workers log by way of this one;
    Ctrl-C here ends them. An exception of `work` is raised here.
    """
    if workers.ray is not None and items:
        from facerf_cli.ray_workers import in_ray

        yield from in_order(in_ray(work, items, workers.ray, workers.jobs, workers.gpus, broken, recover))
    elif workers.jobs > 1 and len(items) > 1:
        yield from in_order(in_processes(work, items, workers.jobs, broken))
    else:
        yield from map(work, items)


def process_died(error: Exception) -> str:
    """Say that an item's process died, and what to do."""
    return f"its process died, perhaps for want of memory; try fewer --jobs ({error})"


def in_order(results: Generator[tuple[int, R]]) -> Generator[R]:
    """Results numbered from 0 as they come, in the order of their numbers."""
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
