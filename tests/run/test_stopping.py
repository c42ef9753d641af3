"""Signals end a process: unwound, or after a short time in any case, without temporary files."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from tests.processes import wait_until

ENVIRONMENT = os.environ | {"PYTHONPATH": str(Path(__file__).parents[2])}
WRITER = """
import ctypes, sys, time
from pathlib import Path
from facerf_cli.files.atomic import atomic_path
from facerf_cli.run.stopping import end_on_signals

end_on_signals(0.2)
try:
    with atomic_path(Path(sys.argv[1], "a.bin")) as temporary:
        temporary.write_bytes(b"half")
        Path(sys.argv[1], "started").touch()
        if sys.argv[2] == "library":
            ctypes.CDLL(None).sleep(60)  # without the interpreter's lock, as torch and OpenImageIO work
        for _ in range(600):
            time.sleep(0.1)
finally:
    if sys.argv[2] == "slow":
        time.sleep(60)
    if sys.argv[2] == "twice":
        Path(sys.argv[1], "unwinding").touch()
        time.sleep(0.5)
"""

SWALLOWER = """
import sys, time
from pathlib import Path
from facerf_cli.files.atomic import atomic_path
from facerf_cli.run.stopping import end_on_signals

class Slow:
    def __del__(self):  # Python ignores what is raised here
        time.sleep(60)

end_on_signals(2)
with atomic_path(Path(sys.argv[1], "a.bin")) as temporary:
    temporary.write_bytes(b"half")
    Path(sys.argv[1], "started").touch()
    if sys.argv[2] == "library":
        try:
            time.sleep(60)
        except BaseException:
            pass
    else:
        Slow()
"""


def started(
    tmp_path: Path,
    kind: str,
    program: str = WRITER,
    heeds: signal.Signals = signal.SIGINT,
    ignores: signal.Signals | None = None,
) -> subprocess.Popen:
    """A program that heeds a signal, even where the tests run under nohup."""

    def prepare() -> None:
        signal.signal(heeds, signal.SIG_DFL)
        if ignores is not None:
            signal.signal(ignores, signal.SIG_IGN)

    (tmp_path / "writer.py").write_text(program)
    command = [sys.executable, str(tmp_path / "writer.py"), str(tmp_path), kind]
    process = subprocess.Popen(command, env=ENVIRONMENT, stderr=subprocess.PIPE, preexec_fn=prepare)
    wait_until((tmp_path / "started").exists, process)
    return process


def temporaries(folder: Path) -> list[Path]:
    return list(folder.glob(".*part-*"))


@pytest.mark.parametrize("kind", ["python", "library", "slow"])
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP])
def test_a_signal_ends_whatever_runs_and_leaves_nothing(
    kind: str, number: signal.Signals, tmp_path: Path
) -> None:
    process = started(tmp_path, kind, heeds=number)
    assert temporaries(tmp_path)
    process.send_signal(number)
    _, said = process.communicate(timeout=50)  # less than the writer's 60 s
    assert process.returncode == 128 + number and said == b""
    assert not temporaries(tmp_path) and not (tmp_path / "a.bin").exists()


def test_a_hangup_that_is_ignored_stays_so(tmp_path: Path) -> None:
    process = started(tmp_path, "python", ignores=signal.SIGHUP)
    process.send_signal(signal.SIGHUP)
    time.sleep(0.5)
    assert process.poll() is None  # as nohup wants it
    process.kill()
    process.communicate()


def test_a_second_ctrl_c_at_once_does_not_stop_the_cleaning(tmp_path: Path) -> None:
    process = started(tmp_path, "twice")
    process.send_signal(signal.SIGINT)
    wait_until((tmp_path / "unwinding").exists, process)
    process.send_signal(signal.SIGINT)
    _, said = process.communicate(timeout=50)
    assert said.count(b"Traceback") == 1  # of the first, which this small program does not catch
    assert not temporaries(tmp_path)


@pytest.mark.parametrize("kind", ["library", "destructor"])
@pytest.mark.parametrize(("number", "code"), [(signal.SIGHUP, 129), (signal.SIGINT, -signal.SIGINT)])
def test_an_exit_that_was_swallowed_is_raised_before_an_output_gets_its_name(
    kind: str, number: signal.Signals, code: int, tmp_path: Path
) -> None:
    process = started(tmp_path, kind, SWALLOWER, number)
    process.send_signal(number)
    _, said = process.communicate(timeout=50)
    assert process.returncode == code and b"ignored" not in said
    assert not (tmp_path / "a.bin").exists() and not temporaries(tmp_path)
