"""One budget of memory for a process, which readers ask before they decode a file.

`--memory` sets it for each job. What a process holds at rest, its libraries and networks, is not in it.
"""

import ctypes
import gc
import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import cast

from facerf_cli.errors import InputError
from facerf_cli.run.machine import memory_bytes

SHARE = 0.5  # of `memory_bytes` that all jobs of a run have together, by default
_GB = 1 << 30
_RELIT_HELD = 4  # relit maps are held this many times while lights are added to them
_M_ARENA_MAX = -8  # of malloc.h
_SELDOM, _USUAL = (50_000, 10, 10), gc.get_threshold()
_set: list[int] = []  # the limit, once it was set
_held: list[int] = []  # what is held besides what is asked for


def set_limit(limit_bytes: int) -> None:
    """Set the budget of this process."""
    _set[:] = [limit_bytes]


def limit_bytes() -> int:
    """The budget of this process."""
    return _set[0] if _set else default_limit()


def default_limit(jobs: int = 1) -> int:
    """A job's part of `SHARE` of the memory that this process may use."""
    return int(SHARE * memory_bytes()) // max(1, jobs)


@contextmanager
def holding(held_bytes: int) -> Iterator[None]:
    """Count what is held meanwhile with whatever is asked for."""
    _held.append(held_bytes)
    try:
        yield
    finally:
        _held.pop()


def left_bytes() -> int:
    """The budget without what is held."""
    return max(0, limit_bytes() - sum(_held))


def batches(count: int, bytes_each: int) -> list[slice]:
    """As many of some sums of lights at a time as fit the memory."""
    at_once = max(1, left_bytes() // (_RELIT_HELD * bytes_each))
    return [slice(first, first + at_once) for first in range(0, count, at_once)]


def give_back() -> None:
    """Return freed memory to the system.

    glibc keeps what lies between blocks in use, so a batch of thousands of items would grow by these gaps.
    """
    if trim := _of_c("malloc_trim"):
        trim(0)


def share_freed() -> None:
    """Let all threads take what any has freed; glibc has a store for each, and a photo would need more."""
    if setting := _of_c("mallopt"):
        setting(_M_ARENA_MAX, 1)


def _of_c(name: str) -> Callable[..., int] | None:
    """A function of glibc; None with another library of C."""
    try:
        return cast("Callable[..., int]", getattr(ctypes.CDLL(None), name))
    except (OSError, AttributeError, TypeError):
        return None


def require(what: str, needed_bytes: int, instead: str) -> None:
    """Raise InputError where something needs more than the budget; `instead` says what else would do."""
    needed_bytes += sum(_held)
    if needed_bytes > limit_bytes():
        least = math.ceil(100 * needed_bytes / _GB) / 100
        raise InputError(
            f"{what}: needs {least:.2f} GB of memory, and {limit_bytes() / _GB:.2f} GB are allowed; "
            f"give --memory {least:.2f} or {instead}"
        )


def collect_seldom() -> None:
    """Look for garbage seldom, for imports make many objects and hardly any garbage."""
    gc.set_threshold(*_SELDOM)


def collect_as_usual() -> None:
    """Look for garbage as often as before `collect_seldom`, but not among the modules, which stay."""
    if gc.get_threshold() == _SELDOM:
        gc.freeze()
        gc.set_threshold(*_USUAL)
