"""--name of the verbs that write files a photo: the same fields and refusals as relight's."""

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from facerf_cli.main import main

VERBS = {
    "predict-olat": "_olat.exr",
    "fit-geometry": "_mesh.glb",
    "estimate-light": "_light.exr",
    "segment": "_segment.exr",
}


@pytest.fixture
def plates(tmp_path: Path) -> Path:
    folder = tmp_path / "plates"
    (folder / "a").mkdir(parents=True)
    for name in ("a/me.jpg", "a/me.png", "shot.0007.png"):
        Image.fromarray(np.zeros((8, 8, 3), np.uint8)).save(folder / name)
    return folder


@pytest.mark.parametrize("verb", VERBS)
def test_outputs_have_the_given_names(verb: str, plates: Path, capsys: pytest.CaptureFixture[str]) -> None:
    line = [verb, str(plates), "-o", str(plates.parent / "out"), "--dry-run"]
    assert main([*line, "--name", "{parent}/{stem}_{ext}_{frame:06}"]) == 0
    said = capsys.readouterr().out
    for name in ("a/me_jpg", "a/me_png", "plates/shot_png_000007"):
        assert f" -> {plates.parent / 'out' / name}{VERBS[verb]}\n" in said
    assert main([*line, "--name", "{dir}/{stem}"]) == 2
    assert "--name names them alike; give it more fields" in capsys.readouterr().err
    assert main([*line, "--name", "{stem}_{light}"]) == 2
    assert "{light} is no field" in capsys.readouterr().err
    assert main([*line, "--name", "../{stem}"]) == 2
