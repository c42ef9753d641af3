"""The turntable's eight cells: the model fills each, faces where it should, is lit from the upper left."""

from dataclasses import replace

import numpy as np
import pytest

from facerf_cli.face.morphable import MorphableModel, load_face_model
from facerf_cli.face.view import _BACKGROUND, draw_turntable

CELL = 48


@pytest.fixture(scope="module")
def cells() -> list[np.ndarray]:
    return cut(draw_turntable(load_face_model(), CELL))


def cut(image: np.ndarray) -> list[np.ndarray]:
    assert image.shape == (2 * CELL, 4 * CELL, 3)
    return [image[r : r + CELL, c : c + CELL] for r in (0, CELL) for c in range(0, 4 * CELL, CELL)]


def covered(cell: np.ndarray) -> np.ndarray:
    return np.abs(cell - _BACKGROUND).max(-1) > 0.01


def test_every_cell_is_filled_and_turns_from_profile_to_profile_in_one_light(cells: list[np.ndarray]) -> None:
    for cell in cells:
        seen = covered(cell)
        assert not seen[[0, -1]].any() and not seen[:, [0, -1]].any()
        assert seen.any(1).sum() > 0.5 * CELL
    widths = [covered(cell).any(0).sum() for cell in cells]
    assert min(widths[3:5]) > max(widths[0], widths[7])
    assert (covered(cells[0]) != covered(cells[7])[:, ::-1]).mean() < 0.01
    for cell in cells[2:6]:
        seen = covered(cell)
        middle = np.arange(CELL) < np.median(np.nonzero(seen)[1])
        left, right = seen & middle, seen & ~middle
        assert cell[left].mean() > 1.05 * cell[right].mean()


def test_a_head_is_shown_from_behind_too(ict_model: MorphableModel) -> None:
    front, behind = (cut(draw_turntable(ict_model, CELL))[at] for at in (0, 4))
    assert covered(behind)[: CELL // 2].sum() > 0.9 * covered(front)[: CELL // 2].sum()
    without = cut(draw_turntable(replace(ict_model, head=None), CELL))[0]
    assert covered(without).sum() != covered(front).sum()
