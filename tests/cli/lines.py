"""Command lines that several tests run, and a measure of what they write."""

from pathlib import Path

import numpy as np

from facerf_cli.files.read import read_image
from facerf_cli.main import main
from tests.astronaut import PATH as PHOTO


def relight(given: Path, output: Path, *line: str, photo: Path = PHOTO) -> int:
    fixed = ["--checkpoint", str(given / "lambert.safetensors"), "--landmarks", str(given / "astronaut.json")]
    return main([*fixed[:2], "relight", str(photo), "-o", str(output), "--lights", "12", *fixed[2:], *line])


def prepare(capture: Path, output: Path, *line: str) -> int:
    """Without checks, which have tests of their own; these masks without heads are black from behind."""
    return main(
        ["prepare-dataset", str(capture), "-o", str(output), "--crop", "96", "--checks", "off", *line]
    )


def face_sides(path: Path) -> tuple[float, float]:
    """Mean light on the left and the right half of the face alone."""
    image = read_image(path)
    assert image.alpha is not None
    columns = np.flatnonzero(image.alpha.max(0) > 0.5)
    middle = (columns[0] + columns[-1]) // 2
    left, right = (image.alpha.copy() for _ in range(2))
    left[:, middle:], right[:, :middle] = 0, 0
    return tuple(float((image.pixels.mean(-1) * side).sum() / side.sum()) for side in (left, right))
