"""Every command line of some pages runs, at toy size and in the pages' order.

A page's lines work in one folder, each on what those before it made. `toy` replaces sizes, addresses and
downloads; torchrun starts two processes that meet by Gloo on this machine.

Lines of all pages that call other programs (oiiotool, ffmpeg, jq, ...) run as they stand, on outputs of
facerf, where the program is installed.
"""

import itertools
import os
import re
import shlex
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image
from safetensors.torch import save_file

from facerf_cli.face.morphable import load_face_model, save_face_model
from facerf_cli.files.read import read_image
from facerf_cli.files.write import write_exr
from facerf_cli.main import main
from facerf_cli.network.features import VggFeatures
from tests.cli.toy_checkpoint import save_toy_checkpoint
from tests.dataset.dataset_fixture import write_small_dataset
from tests.kinds import Folders, Patch
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
        sys.modules["ray"].shutdown()  # tests/test_ray_workers.py connects with settings of its own


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


# Programs of others that lines of the pages call; those that are installed are run.
_OTHERS = ("oiiotool", "ffmpeg", "ffprobe", "exiftool", "magick", "convert", "find", "jq", "parallel")
# They download, install, start a service, submit a job, or need a screen.
_LEFT_OUT = (
    "rembg",
    "pip",
    "pipx",
    "uvx",
    "apt",
    "docker",
    "blender",
    "git",
    "make",
    "man",
    "python3",
    "ray",
)
_LEFT_OUT += ("sbatch", "srun", "tensorboard")
_OURS = ("facerf", "torchrun", "python", ".venv/bin/python", ".", "export")
_PAGES = sorted({*ROOT.glob("docs/*.md"), *ROOT.glob("*.md")} - {ROOT / "CHANGELOG.md"})
_PATH = os.pathsep.join(
    [str(Path(sys.executable).parent), os.environ["PATH"]]
)  # oiiotool is in OpenImageIO's wheel


def shell_lines(page: Path) -> Iterator[str]:
    """The lines of shell blocks, and code in the text that begins with a program and has arguments."""
    fenced = re.compile(r"^```(\w*)\n(.*?)^```", re.DOTALL | re.MULTILINE)
    for language, block in fenced.findall(page.read_text()):
        if language in ("sh", "bash"):
            joined = re.sub(r"(^|\s)#[^\n]*", "", block.replace("\\\n", " "))
            yield from filter(None, map(str.strip, joined.splitlines()))
    for code in re.findall(r"`([^`]+)`", fenced.sub("", page.read_text())):
        if code.startswith(tuple(f"{name} " for name in (*_OTHERS, *_LEFT_OUT))):
            yield " ".join(code.split())


def programs_of(line: str) -> list[str]:
    """The programs that a line calls."""
    words = shlex.shlex(line, posix=True, punctuation_chars=True)
    words.whitespace_split = True
    pairs = itertools.pairwise(["|", *words])
    return [word for before, word in pairs if set(before) <= set("|&;(") and "=" not in word]


def lines_of_others() -> Iterator[Any]:
    """Every line that calls programs of others, skipped where one is not installed."""
    places = {line: page for page in _PAGES for line in shell_lines(page)}
    for line, page in places.items():
        if called := set(programs_of(line)) & set(_OTHERS):
            lacks = sorted(name for name in called if not shutil.which(name, path=_PATH))
            absent = pytest.mark.skipif(bool(lacks), reason=f"not installed: {', '.join(lacks)}")
            yield pytest.param(line, marks=absent, id=f"{page.name}: {line}")


@pytest.fixture(scope="module")
def outputs(tmp_path_factory: Folders) -> Path:
    """A folder with what the lines read, made by facerf from a small photo, and `facerf` in bin/."""
    folder = tmp_path_factory.mktemp("outputs")
    save_toy_checkpoint(folder / "toy.safetensors")
    (folder / "bin").mkdir()
    program = f'#!/bin/sh\nPYTHONPATH="{ROOT}" exec "{sys.executable}" -m facerf_cli "$@"\n'
    (folder / "bin/facerf").write_text(program)
    (folder / "bin/facerf").chmod(0o755)
    with Image.open(ROOT / "examples/astronaut.jpg") as photo:
        photo.resize((192, 192)).save(folder / "me.jpg")
    shutil.copy(folder / "me.jpg", folder / "back.jpg")
    toy = ["--checkpoint", "toy.safetensors"]
    field = ["relight", "me.jpg", "--reflectance", "field", "--lights", "12"]
    named = ["--light", "key=40,25", "--light", "fill=-60,10", "--background", "none", "-o", "me.exr"]
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        assert main([*toy, *field, *named]) == 0
        assert main([*toy, "predict-olat", "me.jpg", "--lights", "4", "--frame", "uv", "-o", "."]) == 0
        assert main(["segment", "me.jpg", "-o", "cut"]) == 0
        assert main(["envmap", "-o", "maps", "--count", "1"]) == 0
        shutil.copy(*Path("maps").glob("*.exr"), "sky.exr")
        assert main([*toy, *field, "--envmap", "sky.exr", "--rotate", "0:360:2", "-o", "out"]) == 0
        if shutil.which("ffmpeg"):
            assert main([*toy, *field, "--envmap", "sky.exr", "--rotate", "0:360:2", "-o", "in.mp4"]) == 0
        shutil.copytree("out", "frames")
        for made, read in (("0000.png", "a.png"), ("0001.png", "b.png"), ("0000.exr", "me_sky.exr")):
            shutil.copy(f"out/me_sky.{made}", read)
        for read in ("back.exr", "beach.exr"):
            shutil.copy("me_sky.exr", read)
        Path("last").touch()
        os.utime("me.jpg", (Path("last").stat().st_mtime + 60,) * 2)
    return folder


@pytest.mark.slow
@pytest.mark.parametrize("line", list(lines_of_others()))
def test_every_line_that_calls_other_programs_runs(line: str, outputs: Path) -> None:
    environment = os.environ | {
        "PATH": os.pathsep.join([str(outputs / "bin"), _PATH]),
        "OMP_NUM_THREADS": "1",
    }
    shell = ["bash", "-o", "pipefail", "-c", line]
    done = subprocess.run(shell, cwd=outputs, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    words = shlex.split(line)
    if "-o" in words and words[0] == "oiiotool":
        assert (outputs / words[words.index("-o") + 1]).is_file()
    if "--over" in words:
        front, back, image = (read_image(outputs / word) for word in words if word.endswith(".exr"))
        assert front.alpha is not None
        expected = front.alpha[..., None] * front.pixels + (1 - front.alpha[..., None]) * back.pixels
        np.testing.assert_allclose(image.pixels, expected, rtol=4e-3, atol=2e-3)  # half floats


def test_programs_that_the_pages_call_are_known() -> None:
    called = {name for page in _PAGES for line in shell_lines(page) for name in programs_of(line)}
    assert {name for name in called if "/" not in name} <= {*_OTHERS, *_LEFT_OUT, *_OURS}
    assert "oiiotool" in called and shutil.which("oiiotool", path=_PATH)
