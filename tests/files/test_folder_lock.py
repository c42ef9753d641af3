"""One run at a time in a folder: the next one waits and says so; no lock stays behind a killed process."""

import logging
import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from facerf_cli.files.atomic import alone_in
from tests.processes import wait_until

ENVIRONMENT = os.environ | {"PYTHONPATH": str(Path(__file__).parents[2])}
HOLDER = """
import sys, time
from pathlib import Path
from facerf_cli.files.atomic import alone_in
with alone_in(Path(sys.argv[1]), ".lock"):
    Path(sys.argv[2], "held").touch()
    while not Path(sys.argv[2], "go").exists():
        time.sleep(0.02)
    Path(sys.argv[2], "done").touch()
"""


def holder(folder: Path, notes: Path) -> subprocess.Popen:
    process = subprocess.Popen([sys.executable, "-c", HOLDER, str(folder), str(notes)], env=ENVIRONMENT)
    wait_until((notes / "held").exists, process)
    return process


def test_the_second_waits_for_the_first_and_says_so(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    out = tmp_path / "new" / "out"
    process = holder(out, tmp_path)
    logging.getLogger("facerf").propagate = True

    class LetGo(logging.Handler):
        def emit(self, record: logging.LogRecord) -> None:
            assert not (tmp_path / "done").exists()
            (tmp_path / "go").touch()

    handler = LetGo()
    logging.getLogger("facerf").addHandler(handler)
    try:
        with alone_in(out, ".lock"):
            assert (tmp_path / "done").exists()
    finally:
        logging.getLogger("facerf").removeHandler(handler)
    process.wait()
    assert f"(process {process.pid})" in caplog.text and str(out) in caplog.text


def test_a_killed_process_holds_nothing(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    process = holder(tmp_path / "out", tmp_path)
    process.send_signal(signal.SIGKILL)
    process.wait()
    with alone_in(tmp_path / "out", ".lock"):
        pass
    assert not caplog.text and not list((tmp_path / "out").iterdir())


def test_an_empty_folder_that_the_lock_has_made_goes_and_what_is_in_one_stays(tmp_path: Path) -> None:
    with alone_in(tmp_path / "new" / "out", ".lock"):
        pass
    assert not list(tmp_path.iterdir())
    with alone_in(tmp_path / "out", ".lock"):
        (tmp_path / "out" / "a.png").touch()
    assert [path.name for path in (tmp_path / "out").iterdir()] == ["a.png"]


def test_a_link_at_the_lock_s_name_is_refused(tmp_path: Path) -> None:
    (tmp_path / "theirs").write_text("theirs")
    (tmp_path / ".lock").symlink_to(tmp_path / "theirs")
    with pytest.raises(OSError), alone_in(tmp_path, ".lock"):
        pass
    assert (tmp_path / "theirs").read_text() == "theirs"
