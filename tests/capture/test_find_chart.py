"""A chart is found wherever it lies, and nothing else is taken for one."""

import numpy as np
import pytest
from skimage import data

from facerf_cli.capture.chart_patches import area_corners, centres, four_turns, homography, project
from facerf_cli.capture.find_chart import find_chart, find_lattices
from tests.capture.chart_image import CAMERA, CORNERS, background, chart_image


@pytest.mark.parametrize("turn", range(4))
def test_a_chart_is_found_whichever_way_it_lies(turn: int) -> None:
    upright = CORNERS if turn % 2 == 0 else np.array([[120.0, 10], [250, 20], [240, 215], [110, 200]])
    corners = four_turns(upright)[turn]
    image = chart_image(corners, matrix=CAMERA, light=(0.8, 1.2), noise=0.01, clutter=0.5, seed=turn)
    found = find_chart(image)
    assert found is not None and np.abs(found - corners).max() < 2


def test_a_large_image_is_searched_small() -> None:
    corners = 4 * CORNERS
    image = np.kron(chart_image(noise=0.01), np.ones((4, 4, 1), np.float32))
    found = find_chart(image)
    assert found is not None and np.abs(found - corners).max() < 8


@pytest.mark.parametrize("kind", ["clutter", "face", "noise", "black", "tiles", "tiny", "thin"])
def test_what_is_no_chart_is_not_taken_for_one(kind: str) -> None:
    draw = np.random.default_rng(5)
    image = {
        "clutter": lambda: background(draw, (240, 320), 1.0),
        "face": lambda: data.astronaut() / 255,
        "noise": lambda: draw.uniform(0, 1, (240, 320, 3)),
        "black": lambda: np.zeros((240, 320, 3)),
        "tiles": lambda: tiles(draw),
        "tiny": lambda: np.ones((2, 3, 3)),
        "thin": lambda: draw.uniform(0, 1, (2, 3000, 3)),
    }[kind]()
    assert find_chart(image.astype(np.float32)) is None


def tiles(draw: np.random.Generator) -> np.ndarray:
    """A wall of tiles in other colours: a grid, but no chart."""
    wall = np.kron(draw.uniform(0, 1, (6, 8, 3)), np.ones((40, 40, 1)))
    wall[::40] = wall[1::40] = wall[:, ::40] = wall[:, 1::40] = 0.03
    return wall


def test_a_lattice_in_perspective_with_gaps_and_strangers() -> None:
    draw = np.random.default_rng(3)
    points = project(homography(area_corners(), CORNERS), centres())
    kept = np.delete(points, [3, 11, 23], axis=0)
    strangers = draw.uniform([0, 0], [330, 240], (8, 2))
    grid = find_lattices(np.r_[kept, strangers], np.full(29, 25.0), 12, 5)[0]
    places = np.array([place for place, index in grid.items() if index < 21])
    assert len(places) == 21 and sorted(np.ptp(places, axis=0)) == [3, 5]
