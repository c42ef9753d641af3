"""A memory budget per process, which readers check before they decode a file.

`--memory` sets it for each job. It does not include what a process holds at rest: libraries and networks.
"""

import ctypes
import gc
import math
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from facerf_cli.errors import InputError
from facerf_cli.run.machine import memory_bytes

SHARE = 0.5  # fraction of `memory_bytes` that all jobs of a run have together, by default
_GB = 1 << 30
_RELIT_HELD = 4  # copies of the relit maps in memory while lights are added to them
_MB = 1 << 20
_MALLOC = {  # options of malloc.h: number and value
    "M_ARENA_MAX": (-8, 1),  # with an arena per thread a photo would need more memory
    "M_MMAP_THRESHOLD": (-3, 32 * _MB),  # the largest: smaller blocks are reused
    "M_TRIM_THRESHOLD": (-1, 64 * _MB),
    "M_TOP_PAD": (-2, 32 * _MB),
}
_SELDOM, _USUAL = (50_000, 10, 10), gc.get_threshold()
_set: list[int] = []  # the limit, once it was set
_held: list[int] = []  # bytes held besides those that `require` asks for


def set_limit(limit_bytes: int) -> None:
    """Set the budget of this process."""
    _set[:] = [limit_bytes]


def limit_bytes() -> int:
    """Return the budget of this process."""
    return _set[0] if _set else default_limit()


def default_limit(jobs: int = 1) -> int:
    """Return one job's part of `SHARE` of the memory that this process may use."""
    return int(SHARE * memory_bytes()) // max(1, jobs)


@contextmanager
def holding(held_bytes: int) -> Iterator[None]:
    """Add bytes to every request within the block."""
    _held.append(held_bytes)
    try:
        yield
    finally:
        _held.pop()


def left_bytes() -> int:
    """Return the part of the budget that is not held."""
    return max(0, limit_bytes() - sum(_held))


def batches(count: int, bytes_each: int) -> list[slice]:
    """Split a number of sums of lights into batches that fit into memory."""
    at_once = max(1, left_bytes() // (_RELIT_HELD * bytes_each))
    return [slice(first, first + at_once) for first in range(0, count, at_once)]


def give_back() -> None:
    """Return freed memory to the system.

    glibc keeps gaps between blocks in use, so a batch of thousands of items would grow by these gaps.
    """
    _call_libc("malloc_trim", 0)


def reuse_freed() -> None:
    """Let all threads reuse what any has freed, without returning it to the system each time.

    Fresh memory has to be cleared by the system, which takes a few hundredths of a photo's time.
    """
    for number, value in _MALLOC.values():
        _call_libc("mallopt", number, value)


def _call_libc(name: str, *arguments: Any) -> None:
    """Call a function of glibc; other C libraries lack it."""
    try:
        function = getattr(ctypes.CDLL(None), name)
    except (OSError, AttributeError, TypeError):
        return
    function(*arguments)


def require(what: str, needed_bytes: int, instead: str) -> None:
    """Raise InputError if something needs more than the budget; `instead` names an alternative."""
    needed_bytes += sum(_held)
    if needed_bytes > limit_bytes():
        least = math.ceil(100 * needed_bytes / _GB) / 100
        raise InputError(
            f"{what}: needs {least:.2f} GB of memory, and {limit_bytes() / _GB:.2f} GB are allowed; "
            f"pass --memory {least:.2f} or {instead}"
        )


def collect_seldom() -> None:
    """Raise the thresholds of garbage collection for imports, which make many objects and little garbage."""
    gc.set_threshold(*_SELDOM)


def collect_as_usual() -> None:
    """Restore the thresholds, and exempt the imported modules from collection."""
    if gc.get_threshold() == _SELDOM:
        gc.freeze()
        gc.set_threshold(*_USUAL)
