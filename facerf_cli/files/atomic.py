"""Whole files or none: an output is written under a temporary name beside its place, then renamed."""

import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from facerf_cli.errors import FacerfError


@contextmanager
def atomic_path(path: Path) -> Iterator[Path]:
    """Yield a temporary path to write a file or a folder at; it takes `path`'s place when the block succeeds.

    The temporary name keeps the suffix (writers choose their format by it) and is hidden, so that a walk over
    the folder does not take it for an input. Missing parent folders are made, and what a killed process left
    of the same output is removed.
    """
    temporary = path.with_name(f".{path.stem}.part-{os.getpid()}{path.suffix}")
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


def _remove_leftovers(path: Path) -> None:
    before, after = f".{path.stem}.part-", path.suffix
    for name in os.listdir(path.parent):
        owner = name[len(before) : len(name) - len(after)]
        if name.startswith(before) and name.endswith(after) and owner.isdecimal() and not _runs(int(owner)):
            _remove(path.with_name(name))


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
