"""Process items one after another, in processes of this machine (`--jobs`), or as tasks of Ray (`--ray`).

If a process is killed, only its own item is lost; joblib and the standard library lose the whole run.
"""

import logging
import os
import signal
import sys
import threading
from collections import deque
from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import closing, contextmanager, suppress
from dataclasses import dataclass
from functools import partial
from types import SimpleNamespace
from typing import Any, TypeVar

from facerf_cli.errors import FacerfError
from facerf_cli.run.logs import LOGGER_NAME, STDERR, log_to_queue
from facerf_cli.run.machine import processors
from facerf_cli.run.stopping import end_on_signals, leave

T = TypeVar("T")
R = TypeVar("R")
Died = Callable[[T, Exception], R]  # makes the result of an item whose worker died
_PATIENCE_S = 1.0  # for a worker to unwind after SIGTERM


@dataclass(frozen=True)
class Workers:
    """Where items are processed.

    Attributes:
        jobs: Number of processes, or of tasks of Ray at a time (0: as many as Ray has processors).
        ray: Address of a Ray cluster, or 'local'; None: processes of this machine.
        gpus: GPUs of each task of Ray; None: one if the cluster has any.
        in_a_row: Number of neighbouring items that a process takes one after the other.
        with_bar: Whether a terminal shows a progress bar.
    """

    jobs: int = 1
    ray: str | None = None
    gpus: int | None = 0
    in_a_row: int = 1
    with_bar: bool = True


def spread(
    work: Callable[[T], R], items: Sequence[T], workers: Workers, died: Died[T, R], title: str = ""
) -> Generator[R]:
    """Yield `work(item)` of each item in the items' order, computed by the workers.

    Workers log through this process; they end when the generator is closed, as by Ctrl-C. An exception of
    `work` is raised here. With a title, a terminal shows a progress bar on standard error.
    """
    from rich.progress import Progress  # --help does without it

    results: Generator[tuple[int, R]]
    if workers.ray is not None and items:
        from facerf_cli.run.ray_workers import in_ray

        results = in_ray(work, items, died, workers.ray, workers.jobs, workers.gpus)
    elif workers.jobs > 1 and len(items) > 1:
        results = in_processes(work, items, workers, died)
    else:
        results = ((number, work(item)) for number, item in enumerate(items))
    # rich would print stdout's lines to its console, stderr: right only if both are one terminal.
    hidden = not (title and workers.with_bar and STDERR.is_terminal)
    bar = Progress(console=STDERR, disable=hidden, redirect_stdout=sys.stdout.isatty())
    early: dict[int, R] = {}
    following = 0
    with bar, closing(results):
        task = bar.add_task(title, total=len(items))
        for number, result in results:
            early[number] = result
            while following in early:
                yield early.pop(following)
                following += 1
                bar.advance(task)


@dataclass
class _Worker:
    """A process, our end of its pipe, and the numbers of its items; it processes the first one."""

    process: Any
    pipe: Any
    row: deque[int]
    is_ready: bool = False

    def receive(self) -> tuple[str, Any]:
        """Receive a message, or notice that the process died; FacerfError if it never started."""
        try:
            kind, content = self.pipe.recv()
        except (EOFError, OSError):
            self.process.join()
            self.pipe.close()
            code = self.process.exitcode
            cause = f"exit code {code}" if code >= 0 else f"killed by {signal.Signals(-code).name}"
            if not self.is_ready:
                raise FacerfError(f"a worker process could not start ({cause}); try --jobs 1") from None
            return "died", ChildProcessError(cause)
        return kind, content

    def send(self, content: Any) -> None:
        """Send a message; `receive` notices that the process died."""
        with suppress(BrokenPipeError, ConnectionResetError):
            self.pipe.send(content)


def in_processes(
    work: Callable[[T], R], items: Sequence[T], workers: Workers, died: Died[T, R]
) -> Generator[tuple[int, R]]:
    """Yield the number and result of each item as they come; a process that dies is replaced.

    Each process has its own pipe: a lock or a queue that processes share could stay locked by a killed one.
    """
    from multiprocessing.connection import wait  # --help does without it

    numbers, length = range(len(items)), workers.in_a_row
    waiting = deque(deque(numbers[first : first + length]) for first in numbers[::length])
    running: dict[Any, _Worker] = {}
    try:
        while waiting or running:
            while waiting and len(running) < workers.jobs:
                worker = _start_worker(workers.jobs, waiting.popleft())
                running[worker.pipe] = worker
            for pipe in wait(list(running)):
                worker = running[pipe]
                kind, content = worker.receive()
                if kind == "record":
                    logging.getLogger(LOGGER_NAME).handle(content)
                elif kind == "raised":
                    raise content
                elif kind == "ready":
                    worker.is_ready = True
                    worker.send(work)
                    worker.send((items[worker.row[0]],))
                elif kind == "result":
                    number = worker.row.popleft()
                    if not worker.row and waiting:
                        worker.row = waiting.popleft()
                    worker.send((items[worker.row[0]],) if worker.row else None)
                    yield number, content
                else:
                    del running[pipe]
                    if worker.row:  # else it has ended after its last item
                        number = worker.row.popleft()
                        waiting.extendleft([worker.row] if worker.row else [])
                        yield number, died(items[number], content)
    finally:
        for worker in running.values():  # SIGTERM lets them remove temporary files
            worker.process.terminate()
        for worker in running.values():
            worker.process.join(1.5 * _PATIENCE_S)
            worker.process.kill()
            worker.process.join()
            worker.pipe.close()


def _start_worker(jobs: int, row: deque[int]) -> _Worker:
    """Start a process, which sends "ready" when it can receive the work and items."""
    import multiprocessing

    spawn = multiprocessing.get_context("spawn")  # torch does not survive a fork once its threads run
    ours, theirs = spawn.Pipe()
    level = logging.getLogger(LOGGER_NAME).level
    process = spawn.Process(target=_serve, args=(theirs, level, max(1, processors() // jobs)))
    process.start()
    theirs.close()  # so that the worker has the only other end, and its death closes the pipe
    return _Worker(process, ours, row)


def _serve(pipe: Any, level: int, threads: int) -> None:
    """Run a worker process: send a result for each item, until None. Imports torch only after this call."""
    os.environ.setdefault("OMP_NUM_THREADS", str(threads))
    for name in ("SIGINT", "SIGHUP"):  # a terminal sends them to all processes; our parent ends us
        if hasattr(signal, name):
            signal.signal(getattr(signal, name), signal.SIG_IGN)
    end_on_signals(_PATIENCE_S, interrupts=False)
    lock = threading.Lock()

    def send(kind: str, content: Any) -> None:
        with lock:  # any thread may log
            pipe.send((kind, content))

    log_to_queue(SimpleNamespace(put_nowait=partial(send, "record")), level)
    try:
        with suppress(EOFError, BrokenPipeError):  # the parent has ended
            send("ready", None)
            work = pipe.recv()
            while (wrapped := pipe.recv()) is not None:
                try:
                    send("result", work(wrapped[0]))
                except Exception as error:
                    send("raised", error)
        leave(0)
    except SystemExit as stop:  # raised by a signal
        leave(stop.code if isinstance(stop.code, int) else 1)


def process_died(error: Exception) -> str:
    """Return the message for an item whose process died."""
    return f"its process died, perhaps for lack of memory; try fewer --jobs ({error})"


def in_shards(work: Callable[[list[T]], None], items: list[T], jobs: int) -> None:
    """Call `work` (picklable) in `jobs` processes, each on every jobs-th item.

    The first error, Ctrl-C or SIGTERM ends all of them and is raised; FacerfError if a process dies.
    """
    shards = [items[job::jobs] for job in range(min(jobs, len(items)))]

    def died(_: list[T], error: Exception) -> None:
        raise FacerfError(process_died(error))

    with closing(in_processes(work, shards, Workers(len(shards)), died)) as results:
        for _ in results:
            pass


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
