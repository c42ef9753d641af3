"""The notebook of the examples runs from top to bottom, and is kept without outputs."""

import contextlib
import io
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import nbformat
import numpy as np
import pytest
from PIL import Image

pytestmark = pytest.mark.slow
ROOT = Path(__file__).parents[1]
NOTEBOOK = ROOT / "examples/facerf.ipynb"


@dataclass(frozen=True)
class Run:
    """What the cells show, images [H, W, C] of 0 to 255, and what they print."""

    images: list[np.ndarray]
    text: str


def cells() -> list[Any]:
    return [cell for cell in nbformat.read(NOTEBOOK, as_version=4).cells if cell.cell_type == "code"]


@pytest.fixture(scope="module")
def run() -> Run:
    """A run of all cells from the root, in this process."""
    images: list[np.ndarray] = []

    def show(image: Any) -> None:
        images.append(np.asarray(Image.open(io.BytesIO(image.data)), np.float32))

    names: dict[str, Any] = {}
    with pytest.MonkeyPatch.context() as patch, contextlib.redirect_stdout(io.StringIO()) as said:
        patch.chdir(ROOT)
        patch.setattr("IPython.display.display", show)
        for cell in cells():
            exec(compile(cell.source, NOTEBOOK.name, "exec"), names)
    return Run(images, said.getvalue())


def test_it_shows_what_it_says(run: Run) -> None:
    photo, lamps, envmap, _, _, compared, _, weighed, person = run.images
    assert all(image[..., :3].std() > 5 for image in run.images)
    face = np.s_[60:180, 170:280]
    left, right = np.split(lamps[:, : photo.shape[1]][face].mean(-1), 2, 1)
    assert right.mean() > 1.2 * left.mean()  # the light is on the image's right
    before, after = (half[face] for half in np.split(compared, 2, 1))
    assert abs(before - after).mean() < 12  # under the estimated light
    assert person.shape[-1] == 4 and 0.1 < (person[..., 3] > 128).mean() < 0.9
    assert weighed.shape == photo.shape and envmap.shape[1] == 2 * envmap.shape[0]

    assert "brightest from azimuth" in run.text


def test_it_is_kept_without_outputs() -> None:
    assert not any(cell.outputs or cell.execution_count for cell in cells())
