"""Waiting for other processes, without a clock: a slow machine only takes longer."""

import subprocess
import time
from collections.abc import Callable


def wait_until(condition: Callable[[], bool], process: subprocess.Popen) -> None:
    """Wait until something holds; fails at once where the process that is to bring it about has ended."""
    while not condition():
        assert process.poll() is None, f"the process ended with {process.returncode} before"
        time.sleep(0.02)
