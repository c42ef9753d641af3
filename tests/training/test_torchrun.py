"""The stage joint with photos under torchrun: a process that is killed, and another number of processes."""

import json
import os
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import pytest
import torch

from tests.processes import wait_until
from tests.training.joint_dataset import write_joint_dataset

ROOT = Path(__file__).parents[2]
ENVIRONMENT = os.environ | {"PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}
ENVIRONMENT["TORCH_DISABLE_SHARE_RDZV_TCP_STORE"] = "1"  # docs/clusters.md
STEPS = 12


def start(place: Path, run: str, processes: int, *options: str, steps: int = STEPS) -> subprocess.Popen:
    torchrun = [sys.executable, "-m", "torch.distributed.run", "--nproc-per-node", str(processes)]
    torchrun += ["--rdzv-backend", "c10d", "--rdzv-endpoint", "localhost:0", "--max-restarts", "1"]
    line = f"-m facerf_cli train -o {run} --preset tiny --stage joint --texture-size 32 --dataset data"
    line += f" --photos photos --batch 2 --workers 0 --jobs 1 --validate-every 3 --steps {steps}"
    with (place / f"{run}.txt").open("w") as said:
        return subprocess.Popen([*torchrun, *line.split(), *options], cwd=place, env=ENVIRONMENT, stderr=said)


def rows_of(folder: Path) -> list[dict]:
    return [json.loads(line) for line in (folder / "log.jsonl").read_text().splitlines()]


def second_process_of(folder: Path) -> int:
    """The process of rank 1 that trains into a folder."""
    for entry in Path("/proc").glob("[0-9]*"):
        try:
            words, variables = ((entry / name).read_bytes().split(b"\0") for name in ("cmdline", "environ"))
        except OSError:
            continue
        if os.fsencode(folder.name) in words and b"RANK=1" in variables:
            return int(entry.name)
    raise AssertionError("no such process")


@pytest.mark.slow
@pytest.mark.skipif(not Path("/proc/self/environ").exists(), reason="finds a process by /proc")
def test_a_killed_process_and_another_number_of_them(tmp_path: Path) -> None:
    write_joint_dataset(tmp_path / "data")
    (tmp_path / "photos").mkdir()
    shutil.copy(ROOT / "examples/astronaut.jpg", tmp_path / "photos")
    assert start(tmp_path, "whole", 2).wait() == 0
    killed = start(tmp_path, "killed", 2, "--resume")
    wait_until((tmp_path / "killed/state.pt").exists, killed)
    os.kill(second_process_of(tmp_path / "killed"), signal.SIGKILL)
    assert killed.wait() == 0, "torchrun starts all processes again, and they resume"
    lines = (tmp_path / "killed.txt").read_text().splitlines()
    said = [line for line in lines if line.startswith("facerf: error: ")]  # if torchrun leaves it the time
    assert all("another process of this run ended" in line for line in said), said
    whole, rows = rows_of(tmp_path / "whole"), rows_of(tmp_path / "killed")
    assert [row["loss"] for row in rows] == [row["loss"] for row in whole]
    assert any("photometric" not in row["terms"] for row in rows), "no step of photos"
    weights, again = (
        torch.load(tmp_path / name / "state.pt", weights_only=True)["networks"]
        for name in ("whole", "killed")
    )
    assert all(torch.equal(weights[name], again[name]) for name in weights)

    shutil.copytree(tmp_path / "whole", tmp_path / "one")
    more = {"whole": 2, "one": 1}
    for run, processes in more.items():
        assert start(tmp_path, run, processes, "--resume", steps=STEPS + 2).wait() == 0
    two, one = ([row["loss"] for row in rows_of(tmp_path / run)] for run in more)
    assert len(one) == STEPS + 2 and one == pytest.approx(two, rel=1e-4)
