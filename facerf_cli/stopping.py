"""Signals that end a process: it unwinds, so that temporary files go, or is ended where that takes too long.

Python runs a handler between two of its instructions, and a library may be minutes away from the next. A
thread therefore waits for the signal's number too (`signal.set_wakeup_fd`).
"""

import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType
from typing import NoReturn

_cleaners: list[Callable[[], None]] = []
_unhurried: list[None] = []  # an entry for each block that ends by itself
_AT_ONCE_S = 1.0  # a second Ctrl-C within this time is the first one, which a shell and a terminal both send


def end_on_signals(patience_s: float, interrupts: bool = True) -> None:
    """Unwind on SIGTERM and SIGHUP, and on SIGINT if `interrupts`; end after `patience_s` in any case.

    A signal that is ignored (`nohup`) stays so. Call it in the main thread.
    """
    numbers = [signal.SIGTERM] + ([signal.SIGHUP] if hasattr(signal, "SIGHUP") else [])
    handled = [number for number in numbers if signal.getsignal(number) is not signal.SIG_IGN]
    for number in handled:
        signal.signal(number, _unwind)
    if interrupts and signal.getsignal(signal.SIGINT) is not signal.SIG_IGN:
        signal.signal(signal.SIGINT, _Interrupt())
    if hasattr(signal, "SIGHUP"):  # elsewhere a pipe cannot be waited for
        ours, theirs = os.pipe()
        os.set_blocking(theirs, False)
        signal.set_wakeup_fd(theirs, warn_on_full_buffer=False)
        threading.Thread(target=_watch, args=(ours, patience_s), daemon=True).start()


def clean_by(cleaner: Callable[[], None]) -> None:
    """Call a function before a process ends without unwinding."""
    _cleaners.append(cleaner)


@contextmanager
def unhurried() -> Iterator[None]:
    """Let the block take its time after a signal, as a step of training does."""
    _unhurried.append(None)
    try:
        yield
    finally:
        _unhurried.pop()


def _unwind(number: int, _: FrameType | None) -> NoReturn:
    signal.signal(number, signal.SIG_IGN)  # a second one must not interrupt the cleaning
    sys.exit(128 + number)


class _Interrupt:
    """The handler of Ctrl-C: the first unwinds; one that comes later, while that takes long, ends."""

    def __init__(self) -> None:
        self._first_s: float | None = None

    def __call__(self, number: int, frame: FrameType | None) -> None:
        now_s = time.monotonic()
        if self._first_s is None:
            self._first_s = now_s
            raise KeyboardInterrupt
        if now_s - self._first_s > _AT_ONCE_S:
            _end(number)


def _watch(pipe: int, patience_s: float) -> None:
    """End the process where a signal's own handler does not: its thread is in a library."""
    while number := os.read(pipe, 1):
        if number[0] != signal.SIGINT and not _unhurried:
            time.sleep(patience_s)
            _end(number[0])


def _end(number: int) -> None:
    for cleaner in _cleaners:
        cleaner()
    os._exit(128 + number)
