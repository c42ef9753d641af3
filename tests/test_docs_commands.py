"""Every command line of some pages runs, at toy size and in the pages' order.

A page's lines work in one folder, each on what those before it made. `toy` replaces sizes, addresses and
downloads; torchrun starts two processes that meet by Gloo on this machine.
"""

import os
import re
import shlex
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.torch import save_file

from facerf_cli.face.morphable import load_face_model, save_face_model
from facerf_cli.files.write import write_exr
from facerf_cli.main import main
from facerf_cli.network.features import VggFeatures
from tests.dataset.dataset_fixture import write_small_dataset
from tests.kinds import Patch
from tests.training.joint_dataset import write_joint_dataset

ROOT = Path(__file__).parents[1]
_COMMAND = re.compile(r'(?:torchrun|facerf|ray start|pip install|examples/\S+) (?:"\$[^"]*"|[^"\n&])*')
_NOT_RUN = ("ray start", "pip install", "examples/paper/tables.sh")  # the last by test_paper_script.py
_TOY = {
    r"--max-time \S+|--steps \d+": "",
    r"--nnodes 2 ": "--nnodes 1 ",
    r"--nproc-per-node 8": "--nproc-per-node 2",
    r'--rdzv-endpoint ("[^"]*"|\S+)': "--rdzv-endpoint localhost:0",
    r"--batch \d+": "--batch 2",
    r"--vgg-weights imagenet": "--vgg-weights vgg.safetensors",
    r"--heads 400": "--preset tiny --heads 7",
    r"(--stage \S+ )--preset paper": r"\1--preset tiny --texture-size 32",
    r"--preset paper": "--preset tiny --stage joint --form paper --texture-size 32",
    r"(facerf_cli|facerf) train": r"\1 train --steps 1 --jobs 1 --workers 0",
    r"--ray \S+": "--ray local",
    r"--jobs 4": "--jobs 1",
    r"relight-dataset data": "relight-dataset data --per-subject 4",
}


def commands_of(page: str) -> list[str]:
    """The command lines in the blocks of a page, comments removed and continued lines joined."""
    text = (ROOT / "docs" / page).read_text()
    blocks = re.findall(r"^```sh\n(.*?)^```", text, re.DOTALL | re.MULTILINE)
    lines = re.sub(r"(^|\s)#[^\n]*", "", "\n".join(blocks).replace("\\\n", " "))
    return [match.strip() for match in _COMMAND.findall(lines)]


def toy(command: str) -> list[str]:
    """The words of a command at toy size."""
    for pattern, replacement in _TOY.items():
        command = re.sub(pattern, replacement, command)
    return shlex.split(os.path.expandvars(command))


@pytest.fixture
def place(tmp_path: Path) -> Iterator[Path]:
    """A folder with all that the pages take for given; a Ray that they start is left at the end."""
    save_face_model(tmp_path / "ict.npz", load_face_model())
    (tmp_path / "examples").symlink_to(ROOT / "examples")
    write_joint_dataset(tmp_path / "dataset")
    write_small_dataset(tmp_path / "data", counts=(2, 1, 1), lights=12, crop_px=48)
    for name in ("photos", "ffhq"):
        (tmp_path / name).mkdir()
        shutil.copy(ROOT / "examples/astronaut.jpg", tmp_path / name)
    for name in ("sky.exr", "hdri/a.exr", "hdri/b.exr"):
        write_exr(tmp_path / name, np.ones((8, 16, 3), np.float32))
    torch.manual_seed(0)
    save_file(VggFeatures().state_dict(), tmp_path / "vgg.safetensors")
    yield tmp_path
    if "ray" in sys.modules:
        sys.modules["ray"].shutdown()  # tests/run/test_ray_workers.py connects with settings of its own


@pytest.mark.slow
@pytest.mark.parametrize(("page", "count"), [("training.md", 6), ("clusters.md", 13), ("tutorial.md", 9)])
def test_every_line_of_the_page_runs(page: str, count: int, place: Path, monkeypatch: Patch) -> None:
    monkeypatch.chdir(place)
    environment = {"SLURM_ARRAY_TASK_ID": "1", "SLURM_ARRAY_TASK_COUNT": "1"}
    for name, value in environment.items():
        monkeypatch.setenv(name, value)
    commands = commands_of(page)
    assert len(commands) == count, commands
    for command in commands:
        if command.startswith(_NOT_RUN):
            continue
        words = toy(command)
        if words[0] == "facerf":
            assert main(words[1:]) == 0, command
            continue
        of_python = [sys.executable, "-m", "torch.distributed.run", *words[1:]]
        path = {"PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}
        assert subprocess.run(of_python, env=os.environ | path).returncode == 0, command
