"""Atomic writes, and one run at a time in an output folder.

An output is written into a hidden folder next to it, made durable, and renamed. The hidden folder belongs to
this process alone, and no link that another user has put there is followed. A power cut leaves the old output
or the new one: the data is on the disk before the rename, and the rename before the next step (Pillai et al.,
'All File Systems Are Not Created Equal', OSDI 2014).

A run holds the lock of its output folder; the next one waits, and then finds what the first has made. The
lock ends with its process, however that ends.
"""

import atexit
import errno
import hashlib
import logging
import os
import platform
import secrets
import shutil
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING

from facerf_cli.errors import FacerfError, InputError
from facerf_cli.run.logs import LOGGER_NAME, printable_line
from facerf_cli.run.stopping import clean_by, end_again

if TYPE_CHECKING:
    from filelock import FileLock

_ABANDONED_S = 24 * 3600  # without a write: then another machine's temporary folder counts as abandoned
_MARK = ".part-"
_LONGEST_STEM = 40  # characters of a name, of up to 4 bytes, that its temporary folder repeats
# Errors of one output's name or folder, which cost its item; others, as of a full disk, end the run.
_OF_ONE_PATH = {errno.ENAMETOOLONG, errno.EEXIST, errno.ENOTDIR, errno.EISDIR, errno.ELOOP, errno.EILSEQ}
_open: set[Path] = set()  # temporary folders of this process
_watched: list[list[Path]] = []  # what was written since each `all_or_none` began
_swept: set[Path] = set()  # folders whose leftovers this process has removed
log = logging.getLogger(LOGGER_NAME)


@contextmanager
def atomic_path(path: Path) -> Iterator[Path]:
    """Yield a temporary path for a file or a folder; it replaces `path` when the block succeeds.

    The temporary path keeps the name (writers choose their format by its suffix), in a hidden folder, so that
    a search does not take it for an input. Missing parent folders are created. What a killed process left in
    the folder is removed. Several machines may write the same output at once.
    """
    try:
        with hidden_folder(path) as room:
            temporary = room / path.name
            with suppress(FileNotFoundError):
                temporary.lstat()  # says that a name is too long, which libraries do not
            yield temporary
            end_again()  # what was written may lack what a library left out
            if not temporary.exists():
                raise FacerfError(f"{path}: could not be written")
            _sync_all(temporary)
            if temporary.is_dir() and path.is_dir() and not path.is_symlink():
                os.replace(path, room / f"{path.name}.old")
            os.replace(temporary, path)
            for written in _watched:
                written.append(path)
            _sync_folder(path.parent)
    except OSError as error:
        kind = InputError if error.errno in _OF_ONE_PATH else FacerfError
        raise kind(f"{path}: cannot write: {error.strerror or error}") from error


@contextmanager
def hidden_folder(path: Path) -> Iterator[Path]:
    """Yield a hidden folder next to an output, of this process alone, which goes with the block."""
    path.parent.mkdir(parents=True, exist_ok=True)
    if (absolute := Path(os.path.abspath(path.parent))) not in _swept:  # for each file it would be quadratic
        _swept.add(absolute)
        sweep_leftovers(path.parent)
    name = f".{path.stem[:_LONGEST_STEM]}{_MARK}{_machine()}-{os.getpid()}-{secrets.token_hex(4)}"
    room = path.parent / name
    _open.add(room)
    try:  # before it is there: an interrupt may come at any time
        room.mkdir(mode=0o700)
        yield room
    finally:
        shutil.rmtree(room, ignore_errors=True)
        _open.discard(room)


@contextmanager
def all_or_none() -> Iterator[None]:
    """Remove what was written in the block, in any thread, where the block fails; an interrupt keeps it."""
    written: list[Path] = []
    _watched.append(written)
    try:
        yield
    except Exception:
        for path in written:
            _remove(path)
        raise
    finally:
        _watched.pop()


def sweep_leftovers(folder: Path) -> None:
    """Remove temporary folders of processes that have ended from a folder."""
    with suppress(OSError):
        for entry in os.scandir(folder):
            if entry.name.startswith(".") and _MARK in entry.name and _is_abandoned(entry):
                _remove(Path(entry.path))


def _remove_own() -> None:
    """Remove what this process is writing."""
    for room in list(_open):
        shutil.rmtree(room, ignore_errors=True)


clean_by(_remove_own)
atexit.register(_remove_own)  # what a Ctrl-C in the midst of removing it has left


def _machine() -> str:
    """An id of this machine, since machines that share a folder may use the same process ids."""
    return hashlib.sha256(platform.node().encode()).hexdigest()[:8]


def _is_abandoned(leftover: os.DirEntry[str]) -> bool:
    machine, _, rest = leftover.name.rpartition(_MARK)[2].partition("-")
    owner = rest.partition("-")[0]
    if len(machine) != len(_machine()) or not owner.isdecimal():
        return False
    if machine == _machine():
        return not _runs(int(owner))
    try:
        return time.time() - leftover.stat(follow_symlinks=False).st_mtime > _ABANDONED_S
    except OSError:  # its process has just renamed or removed it
        return False


def _runs(process: int) -> bool:
    if os.name == "nt":  # os.kill would end the process there; leftovers stay
        return True
    try:
        os.kill(process, 0)
    except (ProcessLookupError, OverflowError):
        return False
    except PermissionError:
        pass
    return True


def _remove(path: Path) -> None:
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path, ignore_errors=True)
    else:
        path.unlink(missing_ok=True)


def _sync_all(path: Path) -> None:
    """Bring a file, or all of a folder, from memory to the disk."""
    if not path.is_dir():
        _sync(path)
        return
    for here, _, files in os.walk(path):
        for name in files:
            _sync(Path(here) / name)
        _sync_folder(Path(here))


def _sync(path: Path) -> None:
    follow = 0 if path.is_dir() else getattr(os, "O_NOFOLLOW", 0)  # a folder may be a link of the user's
    descriptor = os.open(path, os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | follow)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def _sync_folder(folder: Path) -> None:
    """Bring a folder's names to the disk, where its file system can."""
    try:
        _sync(folder)
    except OSError as error:
        if error.errno not in (errno.EINVAL, errno.EACCES, errno.EBADF, errno.ENOTSUP, errno.EISDIR):
            raise


@contextmanager
def alone_in(folder: Path, name: str) -> Iterator[None]:
    """Hold the lock `name` of a folder, which is created; wait for a process that holds it, and say so.

    Folders that were created and are empty in the end are removed. Raises OSError where the folder cannot be
    written to.
    """
    from filelock import FileLock  # --help does without it

    created = [path for path in (folder, *folder.parents) if not path.exists()]
    path = folder / name
    lock = FileLock(path)
    _acquire(lock, path)
    try:
        with suppress(PermissionError):  # Windows keeps a locked file shut
            path.write_text(str(os.getpid()))
        yield
    finally:
        with suppress(PermissionError):
            path.unlink(missing_ok=True)  # first: who waits for it sees that it is another file
        lock.release()
        with suppress(OSError):
            for empty in created:
                empty.rmdir()


def _acquire(lock: "FileLock", path: Path) -> None:
    """Wait for a lock; its folder is made again where the last owner has removed it."""
    from filelock import Timeout

    wait = "%s: another facerf (process %s) writes there; waiting for it"
    waits = False
    while not lock.is_locked:
        path.parent.mkdir(parents=True, exist_ok=True)
        try:
            lock.acquire(blocking=waits)
        except FileNotFoundError:
            pass
        except Timeout:
            owner, waits = "unknown", True
            with suppress(OSError):  # it has just ended
                owner = printable_line(path.read_text(errors="replace")[:20])
            log.warning(wait, path.parent, owner)
