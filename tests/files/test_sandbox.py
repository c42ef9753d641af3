"""A reader in a process of its own: its arrays come, its death is an error."""

import os
import signal
import time
from pathlib import Path

import numpy as np
import pytest

from facerf_cli.files.sandbox import read_in_subprocess


def numbers(path: Path) -> dict[str, np.ndarray]:
    return {"a/b": np.arange(3), "name": np.frombuffer(os.fsencode(path), np.uint8)}


def refusing(path: Path) -> dict[str, np.ndarray]:
    raise KeyError("it lacks\nshapeMU")


def crashing(path: Path) -> dict[str, np.ndarray]:
    signal.raise_signal(signal.SIGSEGV)
    return {}


def endless(path: Path) -> dict[str, np.ndarray]:
    time.sleep(600)
    return {}


def greedy(path: Path) -> dict[str, np.ndarray]:
    return {"a": np.ones(1 << 40, np.uint8)}


def endless_output(path: Path) -> dict[str, np.ndarray]:
    os.ftruncate(1, 3 << 30)
    return {}


def pickled(path: Path) -> dict[str, np.ndarray]:
    return {"a": np.array([print], dtype=object)}


def test_arrays_come_back_by_name(tmp_path: Path) -> None:
    path = tmp_path / os.fsdecode(b"a \xff b")
    arrays = read_in_subprocess(numbers, path)
    assert arrays["a/b"].tolist() == [0, 1, 2] and bytes(arrays["name"]) == os.fsencode(path)


@pytest.mark.parametrize(
    ("reader", "says"),
    [
        ("refusing", "it lacks shapeMU|lacks.nshapeMU"),
        ("crashing", "SIGSEGV"),
        ("endless", "longer than 2 s"),
        ("greedy", "allocate"),
        ("endless_output", "File too large|Errno 27"),
        ("pickled", "."),
    ],
)
def test_what_goes_wrong_there_is_an_error_here(reader: str, says: str, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=says) as raised:
        read_in_subprocess(globals()[reader], tmp_path, time_s=2 if reader == "endless" else 60)
    assert str(raised.value).isprintable()
