"""Signals that end a process: it unwinds, so that temporary files are removed, or is ended if that is slow.

Python runs a handler between two of its instructions, and a library may be minutes away from the next. A
thread therefore also waits for the signal's number (`signal.set_wakeup_fd`).

A library may also catch the exit and continue with half of its work (`except BaseException`, as trimesh's
writer of OBJ does): `end_again` raises it once more, before an output gets its name and after an item.
"""

import atexit
import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from types import FrameType
from typing import Any, NoReturn

_cleaners: list[Callable[[], None]] = []
_unhurried: list[None] = []  # an entry for each block that ends by itself
_ended_by: list[int] = []  # the signal whose exit was raised
_interrupted_s: list[float] = []  # when the first Ctrl-C came
_AT_ONCE_S = 1.0  # a second Ctrl-C within this time is the first one, which a shell and a terminal both send


def end_on_signals(patience_s: float, interrupts: bool = True) -> None:
    """Unwind on SIGTERM and SIGHUP, and on SIGINT if `interrupts`; end after `patience_s` in any case.

    A signal that is ignored (`nohup`) stays ignored. Call it in the main thread.
    """
    handlers: dict[int, Any] = {signal.SIGTERM: _unwind}
    if hasattr(signal, "SIGHUP"):
        handlers[signal.SIGHUP] = _unwind
    if interrupts:
        handlers[signal.SIGINT] = _interrupt
    for number, handler in handlers.items():
        if signal.getsignal(number) is not signal.SIG_IGN:
            signal.signal(number, handler)
    sys.unraisablehook = _silent_about_exits
    if hasattr(signal, "SIGHUP"):  # elsewhere a pipe cannot be waited for
        ours, theirs = os.pipe()
        os.set_blocking(theirs, False)
        signal.set_wakeup_fd(theirs, warn_on_full_buffer=False)
        threading.Thread(target=_watch, args=(ours, patience_s), daemon=True).start()


def end_again() -> None:
    """Raise the exit of a signal again if there was one and the process still runs."""
    if _ended_by:
        _raise_exit(_ended_by[0])


def leave(code: int) -> NoReturn:
    """End the process without unloading libraries: torch takes half a second, nanobind reports leaks."""
    atexit._run_exitfuncs()
    for stream in (sys.stdout, sys.stderr):
        with suppress(OSError):  # the caller has reported that it cannot be written
            stream.flush()
    os._exit(code)


def clean_by(cleaner: Callable[[], None]) -> None:
    """Call a function before a process ends without unwinding."""
    _cleaners.append(cleaner)


@contextmanager
def unhurried() -> Iterator[None]:
    """Let the block finish after a signal, however long it takes, such as a step of training."""
    _unhurried.append(None)
    try:
        yield
    finally:
        _unhurried.pop()


def _unwind(number: int, _: FrameType | None) -> NoReturn:
    signal.signal(number, signal.SIG_IGN)  # a second one must not interrupt the cleaning
    _raise_exit(number)


def _interrupt(number: int, _: FrameType | None) -> None:
    """Unwind at the first Ctrl-C; end at a later one, while unwinding takes long."""
    now_s = time.monotonic()
    if not _interrupted_s:
        _interrupted_s.append(now_s)
        _raise_exit(number)
    if now_s - _interrupted_s[0] > _AT_ONCE_S:
        _end(number)


def _raise_exit(number: int) -> NoReturn:
    _ended_by[:] = [number]
    if number == signal.SIGINT:
        raise KeyboardInterrupt
    sys.exit(128 + number)


def _silent_about_exits(unraisable: Any) -> None:
    """Report an exception that Python cannot raise, unless a signal caused it."""
    if not _ended_by:
        sys.__unraisablehook__(unraisable)


def _watch(pipe: int, patience_s: float) -> None:
    """End the process if the thread that should run a signal's handler stays in a library."""
    while number := os.read(pipe, 1):
        if number[0] != signal.SIGINT and not _unhurried:
            time.sleep(patience_s)
            _end(number[0])


def _end(number: int) -> None:
    for cleaner in _cleaners:
        cleaner()
    os._exit(128 + number)
