"""The notebook of the examples runs from top to bottom, and is kept without outputs."""

import base64
import io
from pathlib import Path
from typing import Any

import nbformat
import numpy as np
import pytest
from nbclient import NotebookClient
from PIL import Image

ROOT = Path(__file__).parents[1]
NOTEBOOK = ROOT / "examples/facerf.ipynb"


@pytest.fixture(scope="module")
def run() -> Any:
    """The notebook after a run of all cells, in a kernel that starts at the root."""
    notebook = nbformat.read(NOTEBOOK, as_version=4)
    client = NotebookClient(notebook, timeout=300, resources={"metadata": {"path": str(ROOT)}})
    return client.execute()


def images(notebook: Any) -> list[np.ndarray]:
    """What the cells show [H, W, C], 0 to 255."""
    shown = [output.data["image/png"] for cell in notebook.cells for output in cell.get("outputs", [])
             if output.output_type == "display_data"]  # fmt: skip
    return [np.asarray(Image.open(io.BytesIO(base64.b64decode(image))), np.float32) for image in shown]


def test_it_shows_what_it_says(run: Any) -> None:
    photo, lamps, envmap, turns, own_map, own, person = images(run)
    assert all(image[..., :3].std() > 5 for image in (photo, lamps, envmap, turns, own_map, own, person))
    face = np.s_[60:180, 170:280]
    left, right = np.split(lamps[:, : photo.shape[1]][face].mean(-1), 2, 1)
    assert right.mean() > 1.2 * left.mean()  # the light is on the image's right
    before, after = (half[face] for half in np.split(own, 2, 1))
    assert abs(before - after).mean() < 12  # under its own light the face comes back
    assert person.shape[-1] == 4 and 0.1 < (person[..., 3] > 128).mean() < 0.9
    assert envmap.shape[1] == 2 * envmap.shape[0]


def test_the_light_that_it_prints(run: Any) -> None:
    text = "".join(
        output.text for cell in run.cells for output in cell.get("outputs", []) if "text" in output
    )
    assert "brightest from azimuth" in text and "Traceback" not in text


def test_it_is_kept_without_outputs() -> None:
    cells = [cell for cell in nbformat.read(NOTEBOOK, as_version=4).cells if cell.cell_type == "code"]
    assert not any(cell.outputs or cell.execution_count for cell in cells)
