"""A folder in SynthHuman's layout."""

from pathlib import Path

import numpy as np
from PIL import Image

from facerf_cli.files.write import write_exr
from tests import astronaut


def write_synthhuman(root: Path, count: int) -> Path:
    """A folder in SynthHuman's layout, of white people before black."""
    folder = root / "synthhuman"
    for number in range(count):
        y, x = np.mgrid[:96, :72]
        person = np.uint8(255) * ((x - 36) ** 2 + (y - 48) ** 2 < (24 + number) ** 2)
        (folder / str(number)).mkdir(parents=True)
        Image.fromarray(np.dstack([person] * 3)).save(folder / f"{number}/rgb_{number:07}.png")
        Image.fromarray(person).save(folder / f"{number}/alpha_{number:07}.png")
    return folder


def write_seen_synthhuman(folder: Path, normals: np.ndarray) -> Path:
    """A folder of the astronaut with normals [H, W, 3], written as OpenCV does: x is in the blue channel."""
    folder.mkdir(exist_ok=True)
    share = astronaut.person().share
    Image.open(astronaut.PATH).save(folder / "rgb_0000000.png")
    Image.fromarray((255 * share).astype(np.uint8)).save(folder / "alpha_0000000.png")
    write_exr(folder / "normal_0000000.exr", normals[..., ::-1])
    return folder
