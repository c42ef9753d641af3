"""Readers in a process of their own, for libraries that a damaged file can crash: HEIC, .mat, HDF5, pickles.

The child sends arrays as an .npz without pickles, so that even a child that a file has taken over can only
send numbers. Its memory, its time and what it sends are limited; its death is an error in one line.
"""

import importlib
import json
import os
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

_MEMORY_BYTES, _SENT_BYTES = 6 << 30, 2 << 30
_TIME_S = 300
_REFUSED = 3  # exit code of a child that says why on stderr
# -P, for the working directory may hold a json.py; the search path is then that of the parent.
_CHILD = "import json, sys; sys.path[:] = json.loads(sys.argv[1])\n"
_CHILD += "from facerf_cli.files.apart import serve; serve()"


def arrays_apart(
    reader: Callable[..., dict[str, np.ndarray]], path: Path, *limits: int, time_s: float = _TIME_S
) -> dict[str, np.ndarray]:
    """Call `reader(path, *limits)`, a function of a module, in a process of its own.

    Raises ValueError with what the reader raised there, or how its process ended.
    """
    command = [sys.executable, "-P", "-c", _CHILD, json.dumps(sys.path), reader.__module__, reader.__name__]
    command += [os.fspath(path), *map(str, limits)]
    with tempfile.TemporaryFile() as file:
        try:
            ended = subprocess.run(
                command, stdin=subprocess.DEVNULL, stdout=file, stderr=subprocess.PIPE, timeout=time_s
            )
        except subprocess.TimeoutExpired:
            raise ValueError(f"reading it takes longer than {time_s:.0f} s") from None
        if ended.returncode == _REFUSED:
            raise ValueError(printable_line(ended.stderr.decode(errors="replace")))
        if code := ended.returncode:
            death = f"signal {-code}" if code < 0 else f"exit code {code}"
            with suppress(ValueError):  # no name
                death = signal.Signals(-code).name
            raise ValueError(f"it makes its reader fail ({death})")
        file.seek(0)
        try:
            with np.load(file, allow_pickle=False) as arrays:
                return dict(arrays)
        except (OSError, EOFError, KeyError, zipfile.BadZipFile) as error:
            raise ValueError(f"its reader sent no arrays ({error})") from None


def serve() -> None:
    """The child: read and send."""
    _, _, module, reader, path, *limits = sys.argv
    if sys.platform != "win32":
        import resource

        own = {
            resource.RLIMIT_AS: _MEMORY_BYTES,
            resource.RLIMIT_FSIZE: _SENT_BYTES,
            resource.RLIMIT_CORE: 0,
        }
        for limit, value in own.items():
            most = resource.getrlimit(limit)[1]
            resource.setrlimit(limit, (value if most < 0 else min(value, most), most))
    try:
        arrays = getattr(importlib.import_module(module), reader)(Path(path), *map(int, limits))
        np.savez(sys.stdout.buffer, **arrays)
    except Exception as error:  # whatever a damaged file makes its library raise
        print(str(error) or type(error).__name__, file=sys.stderr)
        sys.exit(_REFUSED)
