"""`--ray`: the contract of a folder verb, on two workers that are killed while they work."""

import importlib.util
import os
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace

import pytest

from facerf_cli.batch.settings import Shard
from facerf_cli.errors import FacerfError, UsageError
from facerf_cli.run.logs import configure_logging
from facerf_cli.run.ray_workers import connect, in_ray
from tests.batch.toy_batch import run, started
from tests.folders import rows
from tests.processes import wait_until

pytestmark = pytest.mark.slow
needs_ray = pytest.mark.skipif(importlib.util.find_spec("ray") is None, reason="ray is not installed")
NAMES = tuple(f"{letter}.png" for letter in "abcdefgh")
# Workers import tests.batch.toy_batch.
ENVIRONMENT = os.environ | {"PYTHONPATH": str(Path(__file__).parents[2])}
IMPATIENT = {  # Ray waits half a minute by our own settings
    "RAY_NUM_REDIS_GET_RETRIES": "1",
    "RAY_py_gcs_connect_timeout_s": "1",
    "RAY_gcs_server_request_timeout_seconds": "1",
    "RAY_gcs_rpc_server_connect_timeout_s": "1",
}
ITEMS = [f"x/{letter}" for letter in "abcdefgh"]


@pytest.fixture(scope="module")
def two_workers() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("PYTHONPATH", ENVIRONMENT["PYTHONPATH"])
        ray = connect("local", 2)
    yield
    ray.shutdown()


@pytest.fixture
def photos(tmp_path: Path) -> Path:
    configure_logging()
    folder = tmp_path / "photos"
    for name in NAMES:
        path = folder / "x" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(name.encode())
    return folder


def ends(folder: Path) -> dict[str, dict]:
    """How the items of a report ended, without times."""
    return {item: row | {"seconds": None} for item, row in rows(folder, "report.jsonl").items()}


def tree(folder: Path) -> dict[str, bytes]:
    whole = (path for path in sorted(folder.rglob("*.bin")) if ".part-" not in path.parent.name)
    return {path.name: path.read_bytes() for path in whole}


def parts(folder: Path) -> list[Path]:
    """What is being written, or was left."""
    return list(folder.rglob(".*part-*"))


def await_writers(folder: Path) -> None:
    """Wait until what is left was left by processes that have ended; one that never ends hangs here."""
    while any(runs(int(part.name.rpartition(".part-")[2].split("-")[1])) for part in parts(folder)):
        time.sleep(0.1)


def written(tmp_path: Path) -> list[str]:
    return sorted((tmp_path / "written").read_text().split())


@needs_ray
@pytest.mark.parametrize("address", ["nowhere", "ray://head:10001", "127.0.0.1:1", "127.0.0.1:99999"])
def test_a_wrong_address_is_one_line(photos: Path, tmp_path: Path, address: str) -> None:
    with pytest.raises(UsageError, match=f"^--ray {address}: (not an address|cannot be reached)"):
        run(photos, tmp_path / "out", ray=address)


@needs_ray
def test_one_tree_however_it_is_made(photos: Path, tmp_path: Path, two_workers: None) -> None:
    (photos / "x" / "c.png").write_bytes(b"bad")
    ways = {"one": {}, "two": {"jobs": 2}, "ray": {"ray": "local", "jobs": 2}}
    for name, options in ways.items():
        assert run(photos, tmp_path / name, report=True, **options) == 1
    assert run(photos, tmp_path / "shards", Shard(1, 2)) == 1
    assert run(photos, tmp_path / "shards", Shard(2, 2), ray="local") == 0
    assert len(rows(tmp_path / "shards", ".facerf-1-of-2.jsonl")) == 4
    assert run(photos, tmp_path / "shards", report=True) == 1
    for name in (*ways, "shards"):
        assert tree(tmp_path / name) == tree(tmp_path / "one") and len(tree(tmp_path / name)) == 7
        assert ends(tmp_path / name) == ends(tmp_path / "one")
        assert not parts(tmp_path / name)


@needs_ray
def test_a_worker_is_killed_while_it_works(
    photos: Path, tmp_path: Path, two_workers: None, capsys: pytest.CaptureFixture
) -> None:
    (photos / "x" / "b.png").write_bytes(b"wait")
    killer = threading.Thread(target=kill_the_victim, args=(tmp_path,))
    killer.start()
    assert run(photos, tmp_path / "out", ray="local", jobs=2) == 0
    killer.join()
    assert written(tmp_path) == ITEMS
    assert [row["status"] for row in rows(tmp_path / "out").values()] == ["done"] * len(NAMES)
    assert len(tree(tmp_path / "out")) == len(NAMES) and not parts(tmp_path / "out")
    said = capsys.readouterr()
    assert [Path(line).name for line in said.out.splitlines()] == [f"{name[0]}_copy.bin" for name in NAMES]
    assert said.err.count("warning: at ") == len(NAMES) and "Traceback" not in said.err


def kill_the_victim(notes: Path) -> None:
    while not (notes / "victim").exists():
        time.sleep(0.05)
    time.sleep(0.2)  # most likely in the middle of its work
    os.kill(int((notes / "victim").read_text()), signal.SIGKILL)


def runs(process: int) -> bool:
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    return True


@needs_ray
def test_a_worker_is_killed_when_it_has_written(photos: Path, tmp_path: Path, two_workers: None) -> None:
    (photos / "x" / "b.png").write_bytes(b"late")
    assert run(photos, tmp_path / "out", ray="local", jobs=2) == 0
    assert written(tmp_path).count("x/b") == 2  # made again, as nothing says that it was whole
    assert rows(tmp_path / "out")["x/b"]["status"] == "done"


@needs_ray
def test_an_item_that_always_kills_its_worker_is_given_up(
    photos: Path, tmp_path: Path, two_workers: None, capsys: pytest.CaptureFixture
) -> None:
    (photos / "x" / "b.png").write_bytes(b"die")
    assert run(photos, tmp_path / "out", ray="local", jobs=2) == 1
    assert (tmp_path / "died").read_text() == "x/b\n" * 3
    assert written(tmp_path) == [name for name in ITEMS if name != "x/b"]
    assert "b.png: its process died" in capsys.readouterr().err


@needs_ray
def test_an_error_of_the_whole_run_ends_it(photos: Path, tmp_path: Path, two_workers: None) -> None:
    (photos / "x" / "b.png").write_bytes(b"stop")
    (photos / "x" / "c.png").write_bytes(b"wait")
    with pytest.raises(FacerfError, match=r"^the checkpoint is broken$"):
        run(photos, tmp_path / "out", ray="local", jobs=2)
    # A task that is interrupted takes its file away. Ray loses an interruption that comes just before the
    # task begins; then the task is killed, and the next run takes the file away.
    await_writers(tmp_path / "out")
    assert not (tmp_path / "out/x/c_copy.bin").exists()
    for name in ("b.png", "c.png"):
        (photos / "x" / name).write_bytes(name.encode())
    assert run(photos, tmp_path / "out", ray="local", jobs=2) == 0
    assert len(tree(tmp_path / "out")) == len(NAMES) and not parts(tmp_path / "out")


@needs_ray
def test_ctrl_c_leaves_only_whole_files(photos: Path, tmp_path: Path) -> None:
    (photos / "x" / "a.png").write_bytes(b"wait")
    process = started(photos, tmp_path / "out", 2, "local", start_new_session=True)
    wait_until((tmp_path / "victim").exists, process)
    os.killpg(process.pid, signal.SIGINT)  # as a terminal does
    error = process.communicate()[1].rstrip()
    # Ray 2.60 itself sometimes fails a check of its own when its tasks are cancelled.
    assert error.endswith("KeyboardInterrupt") or "task_manager.cc" in error
    assert process.returncode != 0
    await_writers(tmp_path / "out")
    whole = tree(tmp_path / "out")
    assert whole == {name: f"{name[0]}.png".encode() for name in whole} and "a_copy.bin" not in whole
    # What a task leaves that had to be killed, since it was slow to end, the next run takes away.
    (photos / "x" / "a.png").write_bytes(b"a.png")
    assert run(photos, tmp_path / "out") == 0
    assert len(tree(tmp_path / "out")) == len(NAMES) and not parts(tmp_path / "out")


@needs_ray
def test_what_answers_need_not_be_ray(tmp_path: Path) -> None:
    code = "from facerf_cli.run.ray_workers import connect\nimport sys\nconnect(sys.argv[1])"
    environment = os.environ | IMPATIENT
    with socket.create_server(("127.0.0.1", 0)) as server:
        command = [sys.executable, "-c", code, f"127.0.0.1:{server.getsockname()[1]}"]
        result = subprocess.run(command, env=environment, capture_output=True, text=True)
    assert "UsageError: --ray 127.0.0.1:" in result.stderr.splitlines()[-1]


def test_without_ray(photos: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(UsageError, match=r"^--ray: Ray is not installed; pip install 'facerf\[ray\]'$"):
        run(photos, tmp_path / "out", ray="local")


def test_a_lost_cluster_is_one_line_that_says_what_to_do(monkeypatch: pytest.MonkeyPatch) -> None:
    class RayError(Exception):
        pass

    def fail(*_: object, **__: object) -> None:
        raise RayError("The node died. It had much more to say")

    others = ("WorkerCrashedError", "NodeDiedError", "OutOfMemoryError", "ObjectLostError", "RayTaskError")
    ray = SimpleNamespace(
        remote=lambda **_: lambda _: SimpleNamespace(remote=lambda *_: "reference"),
        put=lambda work: work,
        cluster_resources=lambda: {"CPU": 1},
        wait=fail,
        exceptions=SimpleNamespace(RayError=RayError, **dict.fromkeys(others, KeyError)),
        is_initialized=lambda: False,
    )
    monkeypatch.setattr("facerf_cli.run.ray_workers.connect", lambda *_: ray)
    with pytest.raises(
        FacerfError, match=r"^--ray a:1: the cluster was lost \(The node died\); start it again"
    ):
        list(in_ray(str, ["item"], lambda item, error: item, "a:1", 1, 0))
