"""Every line of the documents that calls other programs runs as it stands, on outputs of facerf.

A program that is not installed skips its lines. Results of some recipes are checked.
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
import OpenImageIO as oiio
import pytest
import torch
from PIL import Image

from facerf_cli.files.read import read_image
from facerf_cli.light.envmap import envmap_weights
from facerf_cli.light.sphere import rig_directions
from facerf_cli.main import main
from tests.cli.toy_checkpoint import save_toy_checkpoint
from tests.examples.test_blender import ROOT

PROGRAMS = ("oiiotool", "ffmpeg", "ffprobe", "exiftool", "magick", "convert", "find", "jq", "parallel")
# They download, install, start a service, submit a job, or need a screen.
NOT_RUN = ("rembg", "pip", "pipx", "uvx", "apt", "docker", "blender", "git", "make", "man", "python3", "ray")
NOT_RUN += ("cat", "rm", "sbatch", "srun", "tensorboard")
OURS = ("facerf", "torchrun", "python", ".venv/bin/python", ".", "export")
PAGES = sorted({*ROOT.glob("docs/*.md"), *ROOT.glob("*.md")} - {ROOT / "CHANGELOG.md"})
PATH = os.pathsep.join(
    [str(Path(sys.executable).parent), os.environ.get("PATH", "")]
)  # OpenImageIO's oiiotool


def shell_lines(page: Path) -> Iterator[str]:
    """The lines of shell blocks, and others, and code in the text, that begin with a program."""
    fenced = re.compile(r"^```(\w*)\n(.*?)^```", re.DOTALL | re.MULTILINE)
    text = page.read_text(encoding="utf-8")
    known = tuple(f"{name} " for name in (*PROGRAMS, *NOT_RUN))
    for language, block in fenced.findall(text):
        joined = re.sub(r"(^|\s)#[^\n]*", "", block.replace("\\\n", " "))
        for line in filter(None, map(str.strip, joined.splitlines())):
            if language in ("sh", "bash") or (not language and line.startswith(known)):
                yield line
    for code in re.findall(r"`([^`]+)`", fenced.sub("", text)):
        if code.startswith(known):
            yield " ".join(code.split())


def programs_of(line: str) -> list[str]:
    """The programs that a line calls."""
    words = shlex.shlex(line, posix=True, punctuation_chars=True)
    words.whitespace_split = True
    pairs = itertools.pairwise(["|", *words])
    return [word for before, word in pairs if set(before) <= set("|&;(") and "=" not in word]


LINES = {line: page.name for page in PAGES for line in shell_lines(page)}


def lines_to_run() -> Iterator[Any]:
    """Each line that calls some of the programs, skipped where one is not installed."""
    for line, page in LINES.items():
        if called := set(programs_of(line)) & set(PROGRAMS):
            lacks = sorted(name for name in called if not shutil.which(name, path=PATH))
            absent = pytest.mark.skipif(bool(lacks), reason=f"not installed: {', '.join(lacks)}")
            yield pytest.param(line, marks=absent, id=f"{page}: {line}")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What the lines read, made by facerf from a small photo, and the program facerf in bin/."""
    made = tmp_path_factory.mktemp("recipes")
    save_toy_checkpoint(made / "toy.safetensors")
    (made / "bin").mkdir()
    program = f'#!/bin/sh\nPYTHONPATH="{ROOT}" exec "{sys.executable}" -m facerf_cli "$@"\n'
    (made / "bin/facerf").write_text(program)
    (made / "bin/facerf").chmod(0o755)
    with Image.open(ROOT / "examples/astronaut.jpg") as photo:
        photo.resize((192, 192)).save(made / "me.jpg")
    toy = ["--checkpoint", "toy.safetensors"]
    relight = [*toy, "relight", "me.jpg", "--reflectance", "field", "--lights", "12"]
    named = ["--light", "key=40,25", "--light", "fill=-60,10", "--background", "none", "-o", "me.exr"]
    turned = [*relight, "--envmap", "sky.exr", "--rotate", "0:360:2", "-o"]
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(made)
        assert main([*relight, *named]) == 0
        assert main([*toy, "predict-olat", "me.jpg", "--lights", "4", "--frame", "uv", "-o", "."]) == 0
        assert main(["segment", "me.jpg", "-o", "cut"]) == 0
        assert main(["envmap", "-o", "maps", "--count", "1"]) == 0
        shutil.copy(*Path("maps").glob("*.exr"), "sky.exr")
        assert main([*turned, "out"]) == 0
        if shutil.which("ffmpeg"):
            assert main([*turned, "in.mp4"]) == 0
        shutil.copytree("out", "frames")
        for name in ("me_sky.exr", "back.exr", "beach.exr"):
            shutil.copy("out/me_sky.0000.exr", name)
        for frame, name in enumerate(("a.png", "b.png")):
            shutil.copy(f"out/me_sky.{frame:04d}.png", name)
        shutil.copy("me.jpg", "back.jpg")
        Path("last").touch()
        os.utime("me.jpg", (Path("last").stat().st_mtime + 60,) * 2)  # the one photo that is newer
    return made


def run(line: str, folder: Path) -> None:
    path = {"PATH": os.pathsep.join([str(folder / "bin"), PATH]), "OMP_NUM_THREADS": "1"}
    shell = ["bash", "-o", "pipefail", "-c", line]
    done = subprocess.run(shell, cwd=folder, env=os.environ | path, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr + done.stdout


@pytest.mark.slow
@pytest.mark.parametrize("line", list(lines_to_run()))
def test_a_line_that_calls_other_programs_runs(line: str, folder: Path) -> None:
    run(line, folder)
    words = shlex.split(line)
    if words[0] in ("oiiotool", "ffmpeg") and not words[1].startswith("--"):
        assert (folder / words[-1]).is_file()
    if "--over" in words:
        front, back, image = (read_image(folder / word) for word in words if word.endswith(".exr"))
        assert front.alpha is not None
        expected = front.alpha[..., None] * front.pixels + (1 - front.alpha[..., None]) * back.pixels
        np.testing.assert_allclose(image.pixels, expected, rtol=4e-3, atol=2e-3)  # half floats


def test_every_program_that_the_documents_call_is_run_or_known() -> None:
    called = {name for line in LINES for name in programs_of(line)}
    assert {name for name in called if "/" not in name} <= {*PROGRAMS, *NOT_RUN, *OURS}
    assert "oiiotool" in called and shutil.which("oiiotool", path=PATH)


def recipe(output: str, folder: Path) -> np.ndarray:
    """The pixels that the recipe of an output writes."""
    (line,) = [one for one, page in LINES.items() if page == "recipes.md" and one.endswith(output)]
    run(line, folder)
    return np.asarray(oiio.ImageBuf(str(folder / output)).get_pixels(oiio.FLOAT))


@pytest.mark.slow
def test_mixtures_and_turned_maps_are_what_they_say(folder: Path) -> None:
    count = oiio.ImageBuf(str(folder / "me.exr")).nsubimages
    parts = [oiio.ImageBuf(str(folder / "me.exr"), part, 0) for part in range(count)]
    found = {p.spec().getattribute("oiio:subimagename"): p.get_pixels(oiio.FLOAT) for p in parts}
    wanted = found["key"] * np.array([0.8, 0.7, 0.5]) + 2 * found["fill"]
    np.testing.assert_allclose(recipe("mixed.exr", folder), wanted, rtol=2e-3, atol=1e-5)  # half floats
    rig, sky = rig_directions(50), torch.from_numpy(read_image(folder / "sky.exr").pixels)
    turned = envmap_weights(torch.from_numpy(recipe("turned.exr", folder)[..., :3].copy()), rig)
    assert float((turned - envmap_weights(sky, rig)).abs().max()) > 1e-2
    np.testing.assert_allclose(turned, envmap_weights(sky, rig, rotate_deg=90), rtol=1e-3, atol=1e-4)
