"""Atomic writes: an output is written under a temporary name in its folder, then renamed."""

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

_ABANDONED_S = 24 * 3600  # another machine's temporary file counts as abandoned after so long without a write


@contextmanager
def atomic_path(path: Path) -> Iterator[Path]:
    """Yield a temporary path for a file or a folder; it replaces `path` when the block succeeds.

    The temporary name keeps the suffix (writers choose their format by it) and is hidden, so that a search of
    the folder does not take it for an input. Missing parent folders are created. Temporary files that a
    killed process left for the same output are removed. Several machines may write the same output at once.
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
    """An id of this machine, since machines that share a folder may use the same process ids."""
    return hashlib.sha256(platform.node().encode()).hexdigest()[:8]


def _remove_leftovers(path: Path) -> None:
    """Remove the temporary files of `path` whose processes have ended."""
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
    except OSError:  # its process has just renamed or removed it
        return False


def _runs(process: int) -> bool:
    if os.name == "nt":  # os.kill would end the process there; leftovers stay
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
