"""Every command of docs/recipes.md runs; some results are checked."""

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import OpenImageIO as oiio
import pytest
import torch

from facerf_cli.files.write import write_display, write_exr
from facerf_cli.light.envmap import envmap_weights
from facerf_cli.light.sphere import rig_directions
from tests.integrations.test_nuke_and_blender import ROOT, stack

RECIPES = (ROOT / "docs/recipes.md").read_text(encoding="utf-8")
COMMANDS = [
    line for block in re.findall(r"```bash\n(.*?)```", RECIPES, re.S) for line in block.strip().splitlines()
]
PATH = os.pathsep.join([str(Path(sys.executable).parent), os.environ.get("PATH", "")])


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The files that the recipes take."""
    made = tmp_path_factory.mktemp("recipes")
    random = np.random.default_rng(1)
    image, key, fill = (random.random((24, 32, 3)).astype(np.float32) for _ in range(3))
    matte = np.zeros((24, 32), np.float32)
    matte[:, 8:20] = 1
    write_exr(made / "me.exr", image, matte, {"key": key, "fill": fill, "person.A": matte})
    write_exr(made / "back.exr", np.full((24, 32, 3), 0.25, np.float32))
    sky = np.zeros((256, 512, 3), np.float32)
    sky[100:120, 100:140] = (4, 2, 1)
    write_exr(made / "sky.exr", sky)
    (made / "frames").mkdir()
    for name in ("a.png", "b.png", *(f"frames/me_sky.{frame:04d}.png" for frame in range(3))):
        write_display(made / name, image, 0.0)
    stack(made / "me_olat.exr")
    return made


def run(command: str, folder: Path) -> None:
    program = command.split()[0]
    if shutil.which(program, path=PATH) is None:
        pytest.skip(f"{program} is not installed")
    done = subprocess.run(
        command, shell=True, cwd=folder, env={**os.environ, "PATH": PATH}, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr + done.stdout


def pixels(path: Path) -> np.ndarray:
    return np.asarray(oiio.ImageBuf(str(path)).get_pixels(oiio.FLOAT))


@pytest.mark.parametrize("command", COMMANDS, ids=lambda command: command.split()[-1])
def test_a_recipe_runs(command: str, folder: Path) -> None:
    run(command, folder)
    output = folder / command.split()[-1]
    assert output.exists()


def recipe(output: str, folder: Path) -> np.ndarray:
    """The pixels that the recipe of an output writes."""
    (command,) = [one for one in COMMANDS if one.endswith(output)]
    run(command, folder)
    return pixels(folder / output)


def test_mixtures_backgrounds_and_turned_maps_are_what_they_say(folder: Path) -> None:
    parts = [oiio.ImageBuf(str(folder / "me.exr"), part, 0) for part in range(4)]
    found = {p.spec().getattribute("oiio:subimagename"): p.get_pixels(oiio.FLOAT) for p in parts}
    wanted = found["key"] * np.array([0.8, 0.7, 0.5]) + 2 * found["fill"]
    np.testing.assert_allclose(recipe("mixed.exr", folder), wanted, rtol=2e-3)  # half floats
    found, image = recipe("comp.exr", folder), pixels(folder / "me.exr")
    np.testing.assert_allclose(found[:, :8, :3], 0.25, rtol=1e-3)
    np.testing.assert_allclose(found[:, 8:20, :3], image[:, 8:20, :3], rtol=1e-3)
    rig = rig_directions(50)
    turned = envmap_weights(torch.from_numpy(recipe("turned.exr", folder)[..., :3].copy()), rig)
    sky = torch.from_numpy(pixels(folder / "sky.exr")[..., :3].copy())
    np.testing.assert_allclose(turned, envmap_weights(sky, rig, rotate_deg=90), atol=1e-5)
