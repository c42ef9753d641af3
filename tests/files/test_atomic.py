import os
import subprocess
import sys
import time
from pathlib import Path

import pytest

from facerf_cli.errors import FacerfError
from facerf_cli.files.atomic import _machine, atomic_path


def _dead_process() -> int:
    process = subprocess.Popen([sys.executable, "-c", ""])
    process.wait()
    return process.pid


def test_leftovers_of_a_killed_process_go_with_the_next_write(tmp_path: Path) -> None:
    dead, alive, elsewhere = (f"{_machine()}-{_dead_process()}", f"{_machine()}-{os.getppid()}", "0123abcd-1")
    (tmp_path / f".a.part-{dead}.exr").write_text("half")
    (tmp_path / f".folder.part-{dead}").mkdir()
    (tmp_path / f".a.part-{elsewhere}2.exr").write_text("of a machine that has been off for a week")
    os.utime(tmp_path / f".a.part-{elsewhere}2.exr", (0, time.time() - 7 * 86400))
    kept = [
        tmp_path / f".a.part-{elsewhere}.exr",
        tmp_path / f".a.part-{alive}.exr",
        tmp_path / f".ab.part-{dead}.exr",
        tmp_path / f".a.part-{dead}.txt",
    ]
    for path in kept:
        path.write_text("not ours to remove")
    with atomic_path(tmp_path / "a.exr") as temporary:
        temporary.write_text("whole")
    with atomic_path(tmp_path / "folder") as temporary:
        temporary.mkdir()
    assert sorted(tmp_path.iterdir()) == sorted([*kept, tmp_path / "a.exr", tmp_path / "folder"])


def test_nothing_stays_where_the_writer_fails(tmp_path: Path) -> None:
    with pytest.raises(KeyError), atomic_path(tmp_path / "a.exr") as temporary:
        temporary.write_text("half")
        raise KeyError
    with pytest.raises(FacerfError, match="could not be written"), atomic_path(tmp_path / "a.exr"):
        pass
    assert not list(tmp_path.iterdir())
