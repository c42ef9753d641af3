"""A folder in SynthHuman's layout."""

from pathlib import Path

import numpy as np
from PIL import Image


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
