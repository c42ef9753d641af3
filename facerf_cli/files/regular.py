"""Which paths are opened: regular files. A pipe or a device could be waited for without end."""

import os
import stat
from pathlib import Path

from facerf_cli.errors import InputError


def is_regular(path: Path) -> bool:
    """Return whether a path leads to a regular file; False for names that the system refuses."""
    return regular_size(path) is not None


def regular_size(path: Path) -> int | None:
    """The bytes of a regular file; None for anything else, and for names that the system refuses."""
    try:
        state = os.stat(path)
    except (OSError, ValueError):
        return None
    return state.st_size if stat.S_ISREG(state.st_mode) else None


def require_regular(path: Path, advice: str = "check the path") -> None:
    """Raise InputError unless a path leads to a regular file."""
    try:
        mode = os.stat(path).st_mode
    except FileNotFoundError:
        raise InputError(f"{path}: no such file; {advice}") from None
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror or error}); {advice}") from None
    except ValueError:  # a null character
        raise InputError(f"{str(path)!a}: no file can have this name; {advice}") from None
    if stat.S_ISDIR(mode):
        raise InputError(f"{path}: is a folder, not a file; {advice}")
    if not stat.S_ISREG(mode):
        raise InputError(f"{path}: is a pipe or a device, not a regular file; {advice}")


def read_text(path: Path, limit_bytes: int, advice: str) -> str:
    """Read a regular text file of at most `limit_bytes`, in UTF-8; other bytes are replaced."""
    require_regular(path, advice)
    try:
        with path.open("rb") as stream:
            content = stream.read(limit_bytes + 1)
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror or error}); {advice}") from None
    if len(content) > limit_bytes:
        raise InputError(f"{path}: too large, over {limit_bytes >> 20} MiB; {advice}")
    return content.decode(errors="replace")
