"""One run at a time in an output folder: the next one waits, and then finds what the first has made.

The lock is the system's (`flock`), so that it ends with its process, however that ends; no stale lock stays.
"""

import logging
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from facerf_cli.run.logs import LOGGER_NAME, shown

if sys.platform != "win32":
    import fcntl

log = logging.getLogger(LOGGER_NAME)


@contextmanager
def alone_in(folder: Path, name: str) -> Iterator[None]:
    """Hold the lock `name` of a folder, which is created; wait for a process that holds it, and say so.

    Folders that were created and are empty in the end are removed. Where the file system has no locks, as on
    Windows, nothing is held. Raises OSError where the folder cannot be written to.
    """
    created = [path for path in (folder, *folder.parents) if not path.exists()]
    lock = folder / name
    descriptor = _taken(lock)
    try:
        yield
    finally:
        lock.unlink(missing_ok=True)  # first: who waits for it sees that it is another file
        os.close(descriptor)
        with suppress(OSError):
            for path in created:
                path.rmdir()


def _taken(lock: Path) -> int:
    """Open and lock the file; again where its last owner has removed it meanwhile."""
    while True:
        lock.parent.mkdir(parents=True, exist_ok=True)
        descriptor = os.open(lock, os.O_RDWR | os.O_CREAT | getattr(os, "O_NOFOLLOW", 0), 0o666)
        try:
            _wait_for(descriptor, lock)
            if _is_at(descriptor, lock):
                os.ftruncate(descriptor, 0)
                os.write(descriptor, str(os.getpid()).encode())
                return descriptor
        except BaseException:
            os.close(descriptor)
            raise
        os.close(descriptor)


def _wait_for(descriptor: int, lock: Path) -> None:
    if sys.platform == "win32":
        return
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        owner = shown(os.pread(descriptor, 20, 0).decode(errors="replace"))
        wait = "%s: another facerf (process %s) writes there; waiting for it (--jobs and --shard share work)"
        log.warning(wait, lock.parent, owner)
        fcntl.flock(descriptor, fcntl.LOCK_EX)
    except OSError:  # this file system has no locks
        pass


def _is_at(descriptor: int, lock: Path) -> bool:
    try:
        return os.path.samestat(os.fstat(descriptor), os.stat(lock, follow_symlinks=False))
    except FileNotFoundError:
        return False
