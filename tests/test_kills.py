"""`facerf segment` is killed, lacks space or runs twice at once: the outputs are those of a whole run.

`pytest tests/test_kills.py --kills 100` sends SIGKILL at more moments than the default.
"""

import os
import random
import resource
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from hashlib import sha256
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from tests.folders import rows

pytestmark = pytest.mark.slow

ROOT = Path(__file__).parents[1]
ENVIRONMENT = os.environ | {"PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}
PHOTOS, SIDE_PX = 3, 128


@dataclass(frozen=True)
class Undisturbed:
    """A finished run: inputs, outputs by name, seconds until it makes its folder and until it ends."""

    inputs: Path
    outputs: dict[str, tuple[int, str]]
    first_s: float
    end_s: float


def started(inputs: Path, output: Path, before: Callable[[], None] | None = None) -> "subprocess.Popen[str]":
    """Start `facerf segment`; `before` runs in the new process."""
    line = [sys.executable, "-m", "facerf_cli", "-q", "segment", str(inputs), "-o", str(output)]
    pipes = {"stdout": subprocess.DEVNULL, "stderr": subprocess.PIPE, "text": True}
    return subprocess.Popen(line, env=ENVIRONMENT, preexec_fn=before, **pipes)


def ended(process: "subprocess.Popen[str]") -> int:
    """Wait for a process and return its exit code; a traceback on standard error fails the test."""
    said = process.communicate()[1]
    assert "Traceback" not in said and "unexpected" not in said, said
    return process.returncode


def outputs_of(folder: Path) -> dict[str, tuple[int, str]]:
    """Size in bytes and digest of the visible files of an output folder, by name."""
    contents = {path.name: path.read_bytes() for path in folder.glob("[!.]*")}
    return {name: (len(content), sha256(content).hexdigest()) for name, content in contents.items()}


def assert_whole(folder: Path, undisturbed: Undisturbed) -> None:
    """No output is missing, half-written or different; no temporary file is left; one row per photo."""
    assert outputs_of(folder) == undisturbed.outputs
    assert not [*folder.rglob(".*part-*"), *folder.rglob(".facerf-lock*")]
    ends = rows(folder)
    assert sorted(ends) == sorted(path.stem for path in undisturbed.inputs.iterdir())
    assert not [row for row in ends.values() if row["status"] == "failed"]


def assert_finishes(folder: Path, undisturbed: Undisturbed) -> None:
    """All visible outputs are whole, and another run writes the others."""
    assert outputs_of(folder).items() <= undisturbed.outputs.items()
    assert ended(started(undisturbed.inputs, folder)) == 0
    assert_whole(folder, undisturbed)


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory: pytest.TempPathFactory) -> Undisturbed:
    folder = tmp_path_factory.mktemp("kills")
    (folder / "in").mkdir()
    photo = Image.open(ROOT / "examples/astronaut.jpg").convert("RGB").resize((SIDE_PX, SIDE_PX))
    for number in range(PHOTOS):
        pixels = np.array(photo)
        pixels[0, 0] = number  # so that no two photos are the same
        Image.fromarray(pixels).save(folder / "in" / f"photo_{number}.png")
    start_s, first_s = time.monotonic(), 0.0
    process = started(folder / "in", folder / "out")
    while process.poll() is None:
        if not first_s and (folder / "out").exists():
            first_s = time.monotonic() - start_s
        time.sleep(0.01)
    end_s = time.monotonic() - start_s
    assert ended(process) == 0
    return Undisturbed(folder / "in", outputs_of(folder / "out"), first_s, end_s)


def test_a_killed_run_is_completed_by_a_later_run(
    undisturbed: Undisturbed, tmp_path: Path, pytestconfig: pytest.Config
) -> None:
    moments = random.Random(0)
    for _ in range(pytestconfig.getoption("kills")):
        process = started(undisturbed.inputs, tmp_path / "out")
        time.sleep(moments.uniform(undisturbed.first_s, undisturbed.end_s))
        process.kill()
        process.communicate()
        assert_finishes(tmp_path / "out", undisturbed)
        shutil.rmtree(tmp_path / "out")


def test_files_that_may_not_grow_are_written_by_a_later_run(undisturbed: Undisturbed, tmp_path: Path) -> None:
    size = max(size for size, _ in undisturbed.outputs.values()) // 3

    def limit() -> None:
        resource.setrlimit(resource.RLIMIT_FSIZE, (size, resource.RLIM_INFINITY))

    assert ended(started(undisturbed.inputs, tmp_path / "out", limit)) in (1, 2)
    assert_finishes(tmp_path / "out", undisturbed)


@contextmanager
def small_disk(at: Path, size: int) -> Iterator[None]:
    """A file system of some bytes."""
    at.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", f"size={size}", "none", str(at)]
    if subprocess.run(mount, capture_output=True).returncode:
        pytest.skip("a file system is mounted by root only")
    try:
        yield
    finally:
        subprocess.run(["umount", str(at)], check=True)


def test_what_a_full_disk_lacks_is_written_by_a_later_run(undisturbed: Undisturbed, tmp_path: Path) -> None:
    disk = tmp_path / "disk"
    with small_disk(disk, sum(size for size, _ in undisturbed.outputs.values()) // 2):
        assert ended(started(undisturbed.inputs, disk / "out")) in (1, 2)
        subprocess.run(["mount", "-o", "remount,size=64m", str(disk)], check=True)
        assert_finishes(disk / "out", undisturbed)


def test_two_runs_at_once_write_what_one_writes(undisturbed: Undisturbed, tmp_path: Path) -> None:
    both = [started(undisturbed.inputs, tmp_path / "out") for _ in range(2)]
    assert [ended(process) for process in both] == [0, 0]
    assert_whole(tmp_path / "out", undisturbed)
