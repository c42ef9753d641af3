"""What tests of verbs share: a checkpoint, landmarks, maps and a stack of the example photo."""

import json
from pathlib import Path

import numpy as np
import pytest

from facerf_cli.files.write import write_exr
from facerf_cli.main import main
from tests import astronaut
from tests.cli.toy_checkpoint import save_toy_checkpoint
from tests.synth.conftest import people_folder

__all__ = ["people_folder"]


@pytest.fixture(scope="session")
def given(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a checkpoint, Lambert's law until it is trained, the photo's landmarks and two maps."""
    folder = tmp_path_factory.mktemp("given")
    save_toy_checkpoint(folder / "lambert.safetensors")
    (folder / "astronaut.json").write_text(json.dumps(astronaut.face().landmarks_px.tolist()))
    grey = np.full((8, 16, 3), 0.3, np.float32)
    right = grey.copy()
    right[3:5, 3:5] = 9.0
    write_exr(folder / "maps/grey.exr", grey)
    write_exr(folder / "maps/right.0007.exr", right)
    return folder


@pytest.fixture(scope="session")
def stack(given: Path) -> Path:
    """The photo's face under 12 lights, in the frame of its crop."""
    line = [
        "predict-olat",
        str(astronaut.PATH),
        "--landmarks",
        str(given / "astronaut.json"),
        "--lights",
        "12",
    ]
    checkpoint = ["--checkpoint", str(given / "lambert.safetensors")]
    assert main([*checkpoint, *line, "--frame", "face", "-o", str(given / "olat")]) == 0
    return given / "olat/astronaut_olat.exr"
