"""Readers in a separate process, for libraries that a damaged file can crash: HEIC, .mat, HDF5, pickles.

The child sends arrays as an .npz without pickles, so that even a child under a file's control can send only
numbers. Its memory, run time and output are limited; its death is reported as an error.
"""

import importlib
import json
import os
import resource
import signal
import subprocess
import sys
import tempfile
import zipfile
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import numpy as np

from facerf_cli.run.logs import printable_line

_MEMORY_BYTES, _OUTPUT_BYTES, _TIME_S = 6 << 30, 2 << 30, 300
_READER_FAILED = 3  # exit code of a child that prints the reason to stderr
# -P because the working directory may contain a json.py; the search path is then the parent's.
_CHILD = "import json, sys; sys.path[:] = json.loads(sys.argv[1])\n"
_CHILD += "from facerf_cli.files.sandbox import serve; serve()"


def read_in_subprocess(
    reader: Callable[..., dict[str, np.ndarray]], path: Path, *limits: int, time_s: float = _TIME_S
) -> dict[str, np.ndarray]:
    """Call `reader(path, *limits)`, a module-level function, in a separate process.

    Raises ValueError with the reader's error, or with how its process ended.
    """
    command = [sys.executable, "-P", "-c", _CHILD, json.dumps(sys.path), reader.__module__, reader.__name__]
    command += [os.fspath(path), *map(str, limits)]
    with tempfile.TemporaryFile() as file:
        try:
            child = subprocess.run(
                command, stdin=subprocess.DEVNULL, stdout=file, stderr=subprocess.PIPE, timeout=time_s
            )
        except subprocess.TimeoutExpired:
            raise ValueError(f"reading it takes longer than {time_s:.0f} s") from None
        if child.returncode == _READER_FAILED:
            raise ValueError(printable_line(child.stderr.decode(errors="replace")))
        if code := child.returncode:
            cause = f"signal {-code}" if code < 0 else f"exit code {code}"
            with suppress(ValueError):  # a signal without a name
                cause = signal.Signals(-code).name
            raise ValueError(f"its reader crashed ({cause})")
        file.seek(0)
        try:
            with np.load(file, allow_pickle=False) as arrays:
                return dict(arrays)
        except (OSError, EOFError, KeyError, zipfile.BadZipFile) as error:
            raise ValueError(f"its reader sent no arrays ({error})") from None


def serve() -> None:
    """Run the reader in the child process and write its arrays to stdout."""
    _, _, module, reader, path, *limits = sys.argv
    for limit, value in (
        (resource.RLIMIT_AS, _MEMORY_BYTES),
        (resource.RLIMIT_FSIZE, _OUTPUT_BYTES),
        (resource.RLIMIT_CORE, 0),
    ):
        hard = resource.getrlimit(limit)[1]
        resource.setrlimit(limit, (value if hard < 0 else min(value, hard), hard))
    try:
        arrays = getattr(importlib.import_module(module), reader)(Path(path), *map(int, limits))
        np.savez(sys.stdout.buffer, **arrays)
    except Exception as error:  # any exception that a damaged file causes in its library
        print(str(error) or type(error).__name__, file=sys.stderr)
        sys.exit(_READER_FAILED)
