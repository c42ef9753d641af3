import errno
import logging
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from facerf_cli.errors import FacerfError, InputError
from facerf_cli.files import atomic
from facerf_cli.files.atomic import alone_in, atomic_path, machine_id
from tests.kinds import Log, Patch
from tests.processes import wait_until


@pytest.fixture(autouse=True)
def _no_folder_was_swept(monkeypatch: Patch) -> None:
    monkeypatch.setattr(atomic, "_swept", set())


def _dead_process() -> int:
    process = subprocess.Popen([sys.executable, "-c", ""])
    process.wait()
    return process.pid


def test_leftovers_of_a_killed_process_go_with_the_next_write(tmp_path: Path) -> None:
    dead, alive, elsewhere = (
        f"{machine_id()}-{_dead_process()}",
        f"{machine_id()}-{os.getppid()}",
        "0123abcd-1",
    )
    (tmp_path / f".part-{dead}-00ff").mkdir()
    (tmp_path / f".part-{dead}-00ff" / "a.exr").write_text("half")
    (tmp_path / f".part-{elsewhere}2-00ff").mkdir()
    os.utime(tmp_path / f".part-{elsewhere}2-00ff", (0, time.time() - 7 * 86400))
    kept = [
        tmp_path / f".part-{elsewhere}-00ff",
        tmp_path / f".part-{alive}-00ff",
        tmp_path / ".part-x",
        tmp_path / ".part-of-a-song",
    ]
    for path in kept:
        path.mkdir()
    os.utime(kept[-1], (0, 0))
    with atomic_path(tmp_path / "a.exr") as temporary:
        temporary.write_text("whole")
    with atomic_path(tmp_path / "folder") as temporary:
        temporary.mkdir()
    assert sorted(tmp_path.iterdir()) == sorted([*kept, tmp_path / "a.exr", tmp_path / "folder"])


def test_nothing_stays_where_the_writer_fails_and_long_names_have_temporary_ones(tmp_path: Path) -> None:
    with pytest.raises(KeyError), atomic_path(tmp_path / "a.exr") as temporary:
        temporary.write_text("half")
        raise KeyError
    with pytest.raises(FacerfError, match="could not be written"), atomic_path(tmp_path / "a.exr"):
        pass
    assert not list(tmp_path.iterdir())
    for name in ("n" * 251 + ".txt", "\U0001f642" * 62 + ".txt"):  # 252 bytes and more
        with atomic_path(tmp_path / name) as temporary:
            temporary.write_text("x")
        assert (tmp_path / name).read_text() == "x"


def test_an_interrupt_while_the_temporary_folder_is_made_leaves_none(
    tmp_path: Path, monkeypatch: Patch
) -> None:
    make = os.mkdir

    def interrupted(path: Path, mode: int = 0o777) -> None:
        make(path, mode)
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(os, "mkdir", interrupted)
        with pytest.raises(KeyboardInterrupt), atomic.hidden_folder(tmp_path / "a.exr"):
            pass
    assert not list(tmp_path.iterdir())


def test_links_and_folders_in_the_place_of_an_output_are_replaced(tmp_path: Path) -> None:
    (tmp_path / "theirs").write_text("theirs")
    (tmp_path / "a.txt").symlink_to(tmp_path / "theirs")
    with atomic_path(tmp_path / "a.txt") as temporary:
        temporary.write_text("ours")
    assert (tmp_path / "theirs").read_text() == "theirs" and not (tmp_path / "a.txt").is_symlink()
    for number in ("1", "2"):
        with atomic_path(tmp_path / "page") as temporary:
            temporary.mkdir()
            (temporary / number).write_text("x")
    assert [path.name for path in (tmp_path / "page").iterdir()] == ["2"]
    assert {path.name for path in tmp_path.iterdir()} == {"a.txt", "page", "theirs"}


class Disk:
    """A disk that loses at a power cut what was not brought to it, in the way that is worst.

    It records `fsync` and `replace` of a write. After a cut a file that was not synced is empty, and a rename
    has happened or not, unless its folder was synced after it.
    """

    def __init__(self, monkeypatch: Patch, path: Path, old: str) -> None:
        self.path, self.old = path, old
        self.synced: dict[int, str] = {}  # contents by inode
        self.states: list[set[str]] = [{old}]  # what a cut may leave at `path`, after each step
        self._fsync, self._replace = os.fsync, os.replace
        monkeypatch.setattr(os, "fsync", self.fsync)
        monkeypatch.setattr(os, "replace", self.replace)

    def fsync(self, descriptor: int) -> None:
        self._fsync(descriptor)
        state = os.fstat(descriptor)
        if os.path.isdir(f"/proc/self/fd/{descriptor}"):
            renamed = os.path.samestat(state, os.stat(self.path.parent)) and len(self.states) > 1
            self.states.append({self._durable()} if renamed else self.states[-1])
        else:
            self.synced[state.st_ino] = Path(f"/proc/self/fd/{descriptor}").read_text()

    def replace(self, source: Path, target: Path) -> None:
        self._replace(source, target)
        self.states.append({self.old, self._durable()})

    def _durable(self) -> str:
        return self.synced.get(self.path.stat().st_ino, "lost")


@pytest.mark.parametrize("lacks", ["", "fsync of the file", "fsync of the folder"])
def test_a_power_cut_leaves_the_old_or_the_new(lacks: str, tmp_path: Path, monkeypatch: Patch) -> None:
    if not os.path.isdir("/proc/self/fd"):
        pytest.skip("needs /proc")
    path = tmp_path / "a.txt"
    path.write_text("old")
    disk = Disk(monkeypatch, path, "old")
    nothing: Callable[..., None] = lambda *_: None  # noqa: E731
    if lacks:  # the test must be able to fail
        sync = atomic._sync
        lost = (lambda at: None if at == tmp_path else sync(at)) if "folder" in lacks else nothing
        monkeypatch.setattr(atomic, "_sync" if "folder" in lacks else "_sync_all", lost)
    with atomic_path(path) as temporary:
        temporary.write_text("new")
    never_half = all(state <= {"old", "new"} for state in disk.states)
    assert (never_half, disk.states[-1] == {"new"}) == (lacks != "fsync of the file", lacks == "")


def test_all_of_a_folder_is_brought_to_the_disk(tmp_path: Path, monkeypatch: Patch) -> None:
    synced: list[str] = []
    monkeypatch.setattr(atomic, "_sync", lambda path: synced.append(path.name))
    with atomic_path(tmp_path / "page") as temporary:
        (temporary / "images").mkdir(parents=True)
        (temporary / "images" / "a.png").write_text("x")
        (temporary / "index.html").write_text("x")
    assert set(synced) == {"a.png", "index.html", "images", "page", tmp_path.name}
    assert synced[-1] == tmp_path.name


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


def test_the_second_waits_for_the_first_and_says_so(tmp_path: Path, caplog: Log) -> None:
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


def test_a_killed_process_holds_nothing(tmp_path: Path, caplog: Log) -> None:
    process = holder(tmp_path / "out", tmp_path)
    process.send_signal(signal.SIGKILL)
    process.wait()
    with alone_in(tmp_path / "out", ".lock"):
        pass
    assert not caplog.text and not list((tmp_path / "out").iterdir())


@pytest.mark.parametrize("error", [errno.ENOLCK, errno.ENOTSUP, errno.EOPNOTSUPP, errno.ENOSYS])
def test_a_file_system_without_locks_costs_a_warning(
    error: int, tmp_path: Path, caplog: Log, monkeypatch: Patch
) -> None:
    monkeypatch.setattr("fcntl.flock", refuse := Refusal(error))
    logging.getLogger("facerf").propagate = True
    for out in (tmp_path / "there", tmp_path / "new" / "out"):
        with alone_in(out, ".lock"), alone_in(out, ".lock"):  # nobody waits
            (out / "a.png").touch()
        assert [path.name for path in out.iterdir()] == ["a.png"]
        assert str(out) in caplog.text and os.strerror(error) in caplog.text
    refuse.error = errno.EIO
    with pytest.raises(OSError, match=os.strerror(errno.EIO)), alone_in(tmp_path, ".lock"):
        pass


class Refusal:
    """A lock that fails."""

    def __init__(self, error: int) -> None:
        self.error = error

    def __call__(self, *_: int) -> None:
        raise OSError(self.error, os.strerror(self.error))


def test_a_link_at_the_locks_name_is_refused_and_an_output_folder_may_be_one(tmp_path: Path) -> None:
    (tmp_path / "theirs").write_text("theirs")
    (tmp_path / ".lock").symlink_to(tmp_path / "theirs")
    with pytest.raises(OSError), alone_in(tmp_path, ".lock"):
        pass
    assert (tmp_path / "theirs").read_text() == "theirs"
    (tmp_path / "real").mkdir()
    (tmp_path / "link").symlink_to("real")
    with atomic_path(tmp_path / "link" / "a.txt") as temporary:
        temporary.write_text("whole")
    assert (tmp_path / "real" / "a.txt").read_text() == "whole"
    with alone_in(tmp_path / "new" / "out", ".lock"):
        pass
    assert not (tmp_path / "new").exists()
    with alone_in(tmp_path / "out", ".lock"):
        (tmp_path / "out" / "a.png").touch()
    assert [path.name for path in (tmp_path / "out").iterdir()] == ["a.png"]


@pytest.mark.parametrize("name", ["n" * 256, "taken/a.txt", "nowhere/a.txt"])
def test_a_name_that_cannot_be_costs_its_own_item(tmp_path: Path, name: str) -> None:
    (tmp_path / "taken").write_text("a file")
    (tmp_path / "nowhere").symlink_to(tmp_path / "not there")
    with pytest.raises(InputError, match="cannot write"), atomic_path(tmp_path / name):
        pass
