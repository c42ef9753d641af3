"""Ctrl-C and SIGTERM end a run between two steps, so that nothing is lost; a second one ends it at once."""

import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

_SIGNALS = (signal.SIGINT, signal.SIGTERM)


@dataclass
class Stop:
    """Whether the run was asked to end."""

    signal: int = 0

    def leave(self) -> None:
        """End as the signal would have."""
        if self.signal == signal.SIGINT:
            raise KeyboardInterrupt
        if self.signal:
            sys.exit(128 + self.signal)


@contextmanager
def stop_on_signals() -> Iterator[Stop]:
    """Note the signals in the place of their handlers; threads but the main one cannot."""
    stop = Stop()
    if threading.current_thread() is not threading.main_thread():
        yield stop
        return

    def note(number: int, _: Any) -> None:
        stop.signal = number
        for which, handler in before.items():
            signal.signal(which, handler)

    before = {which: signal.signal(which, note) for which in _SIGNALS}
    try:
        yield stop
    finally:
        for which, handler in before.items():
            signal.signal(which, handler)
