"""Atomic writes, and locks of output folders.

An output is written into a hidden folder next to it, which only this process uses, synced to the disk, and
renamed. A power cut leaves the old or the new output: data is on the disk before the rename, and the rename
before the next step (Pillai et al., 'All File Systems Are Not Created Equal', OSDI 2014).

A run holds the lock of its output folder; the next run waits for it. The lock ends with its process.
"""

import atexit
import errno
import hashlib
import logging
import os
import platform
import re
import secrets
import shutil
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from facerf_cli.errors import FacerfError, InputError
from facerf_cli.run.logs import LOGGER_NAME, printable_line
from facerf_cli.run.stopping import clean_by, end_again

_ABANDONED_S = 24 * 3600  # age of another machine's temporary folder that counts as abandoned
_MARK = ".part-"  # start of a temporary folder's name
_TEMPORARY = re.compile(r"\.part-([0-9a-f]{8})-(\d+)-[0-9a-f]+")  # with its machine and process
# Errors of one output's path, which fail its item; others, such as a full disk, end the run.
_OF_ONE_PATH = {errno.ENAMETOOLONG, errno.EEXIST, errno.ENOTDIR, errno.EISDIR, errno.ELOOP, errno.EILSEQ}
_NO_LOCKS = {errno.ENOLCK, errno.ENOTSUP, errno.EOPNOTSUPP, errno.ENOSYS}  # NFS, SMB and Lustre without them
_open: set[Path] = set()  # temporary folders of this process
_watched: list[list[Path]] = []  # files written since each `all_or_none` began
_asked: list[Callable[[Path, Path], bool]] = []  # called before a file is replaced; see `asking`
_swept: set[Path] = set()  # folders whose leftovers this process has removed
log = logging.getLogger(LOGGER_NAME)


@contextmanager
def atomic_path(path: Path) -> Iterator[Path]:
    """Yield a temporary path for a file or a folder; it replaces `path` when the block succeeds.

    The temporary path has the same name (writers choose their format by its suffix) in a hidden folder, which
    searches for inputs skip. Missing parent folders are created, and leftovers of killed processes removed.
    Several machines may write the same output at once.
    """
    try:
        with hidden_folder(path) as room:
            temporary = room / path.name
            with suppress(FileNotFoundError):
                temporary.lstat()  # reports a name that is too long, which libraries do not
            yield temporary
            end_again()  # a library may have caught the exit and written a part
            if not temporary.exists():
                raise FacerfError(f"{path}: could not be written")
            _sync_all(temporary)
            if not all([ask(path, temporary) for ask in _asked]):
                return
            if temporary.is_dir() and path.is_dir() and not path.is_symlink():
                os.replace(path, room / f"{path.name}.old")
            os.replace(temporary, path)
            for written in _watched:
                written.append(path)
            with suppress(OSError):  # some file systems do not sync folders
                _sync(path.parent)
    except OSError as error:
        kind = InputError if error.errno in _OF_ONE_PATH else FacerfError
        raise kind(f"{path}: cannot write: {error.strerror or error}") from error


@contextmanager
def hidden_folder(path: Path) -> Iterator[Path]:
    """Yield a hidden folder of this process next to an output; it is removed after the block."""
    path.parent.mkdir(parents=True, exist_ok=True)
    if (absolute := Path(os.path.abspath(path.parent))) not in _swept:  # once per folder, not per file
        _swept.add(absolute)
        sweep_leftovers(path.parent)
    room = path.parent / f"{_MARK}{machine_id()}-{os.getpid()}-{secrets.token_hex(4)}"
    _open.add(room)
    try:  # before it is created: an interrupt may come at any time
        room.mkdir(mode=0o700)
        yield room
    finally:
        shutil.rmtree(room, ignore_errors=True)
        _open.discard(room)


@contextmanager
def asking(ask: Callable[[Path, Path], bool]) -> Iterator[None]:
    """Call `ask(path, temporary)` before each output of the block is renamed, in any thread.

    If it returns False, the file at `path` is not replaced. It may raise.
    """
    _asked.append(ask)
    try:
        yield
    finally:
        _asked.pop()


@contextmanager
def all_or_none() -> Iterator[None]:
    """Remove files written in the block, in any thread, if it fails; an interrupt keeps them."""
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
    """Remove temporary folders of ended processes from a folder."""
    with suppress(OSError):
        for entry in os.scandir(folder):
            if _is_abandoned(entry):
                _remove(Path(entry.path))


def _remove_own() -> None:
    for room in list(_open):
        shutil.rmtree(room, ignore_errors=True)


def is_temporary(path: Path) -> bool:
    """Return whether a path is in a temporary folder of `atomic_path`."""
    return any(part.startswith(_MARK) for part in path.parts)


clean_by(_remove_own)
atexit.register(_remove_own)  # folders that are still in use, and after a Ctrl-C during a removal


def machine_id() -> str:
    """Return an id of this machine, since machines that share a folder may use the same process ids."""
    return hashlib.sha256(platform.node().encode()).hexdigest()[:8]


def _is_abandoned(leftover: os.DirEntry[str]) -> bool:
    if (match := _TEMPORARY.fullmatch(leftover.name)) is None:
        return False
    machine, owner = match.groups()
    try:
        if machine != machine_id():
            return time.time() - leftover.stat(follow_symlinks=False).st_mtime > _ABANDONED_S
        os.kill(int(owner), 0)
    except (ProcessLookupError, OverflowError):
        return True
    except OSError:  # another user's process, or a folder that was just removed
        pass
    return False


def _remove(path: Path) -> None:
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path, ignore_errors=True)
    else:
        path.unlink(missing_ok=True)


def _sync_all(path: Path) -> None:
    """Sync a file, or a folder and everything in it, to the disk."""
    for inside in path.rglob("*") if path.is_dir() else ():
        _sync(inside)
    _sync(path)


def _sync(path: Path) -> None:
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


@contextmanager
def alone_in(folder: Path, name: str) -> Iterator[None]:
    """Hold the lock `name` of a folder, which is created; wait for a process that holds it, and log that.

    On file systems without locks, warn and continue. New folders are removed if they are still empty at the
    end. Raises OSError if the folder is not writable.
    """
    from filelock import FileLock, Timeout  # not needed for --help

    created = [path for path in (folder, *folder.parents) if not path.exists()]
    path = folder / name
    lock = FileLock(path, fallback_to_soft=False)  # a soft lock would outlive a killed process
    waits = False
    try:
        while not lock.is_locked:
            folder.mkdir(parents=True, exist_ok=True)  # the last owner may have removed it
            try:
                lock.acquire(blocking=waits)
            except FileNotFoundError:
                pass
            except Timeout:
                owner, waits = "unknown", True
                with suppress(OSError):  # just ended
                    owner = printable_line(path.read_text(errors="replace")[:20])
                log.warning("%s: waiting for another facerf (process %s)", folder, owner)
    except OSError as error:
        if error.errno not in _NO_LOCKS:
            raise
        log.warning(
            "%s: the file system has no locks (%s); run only one facerf there", folder, error.strerror
        )
    try:
        path.write_text(str(os.getpid()))
        yield
    finally:
        path.unlink(missing_ok=True)  # before the release, so that waiting processes see a new file
        lock.release()
        with suppress(OSError):
            for empty in created:
                empty.rmdir()
