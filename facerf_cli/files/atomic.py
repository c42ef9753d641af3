"""Whole files or none: an output is written under a temporary name beside its place, then renamed."""

import hashlib
import os
import platform
import shutil
import time
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path

from facerf_cli.errors import FacerfError

_ABANDONED_S = 24 * 3600  # what no machine has written to for so long, nobody is writing


@contextmanager
def atomic_path(path: Path) -> Iterator[Path]:
    """Yield a temporary path to write a file or a folder at; it takes `path`'s place when the block succeeds.

    The temporary name keeps the suffix (writers choose their format by it) and is hidden, so that a walk over
    the folder does not take it for an input. Missing parent folders are made, and what a killed process left
    of the same output is removed. Machines that share the folder may write the same output at once.
    """
    temporary = path.with_name(f".{path.stem}.part-{_machine()}-{os.getpid()}{path.suffix}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        _remove_leftovers(path)
        yield temporary
        if not temporary.exists():
            raise FacerfError(f"{path}: could not be written")
        if temporary.is_dir() and path.is_dir():
            shutil.rmtree(path)
        os.replace(temporary, path)
    except OSError as error:
        raise FacerfError(f"{path}: cannot write: {error.strerror or error}") from error
    finally:
        _remove(temporary)


@cache
def _machine() -> str:
    """What tells this machine from others that write to the same folder and count processes anew."""
    return hashlib.sha256(platform.node().encode()).hexdigest()[:8]


def _remove_leftovers(path: Path) -> None:
    before, after = f".{path.stem}.part-", path.suffix
    for name in os.listdir(path.parent):
        machine, _, owner = name[len(before) : len(name) - len(after)].partition("-")
        ours = name.startswith(before) and name.endswith(after) and owner.isdecimal()
        if ours and _is_abandoned(path.with_name(name), machine, int(owner)):
            _remove(path.with_name(name))


def _is_abandoned(leftover: Path, machine: str, owner: int) -> bool:
    if machine == _machine():
        return not _runs(owner)
    try:
        return time.time() - leftover.stat().st_mtime > _ABANDONED_S
    except OSError:  # its owner has taken it away
        return False


def _runs(process: int) -> bool:
    if os.name == "nt":  # where signal 0 is no question; leftovers stay
        return True
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except PermissionError:
        pass
    return True


def _remove(path: Path) -> None:
    if path.is_dir():
        shutil.rmtree(path, ignore_errors=True)
    elif path.exists():
        path.unlink()
