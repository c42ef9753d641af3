"""Ears are likelier near the network's landmarks of them; what it is sure of stays."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from facerf_cli.portrait.classes import CLASSES, MORE_LANDMARKS, class_index
from facerf_cli.portrait.parse import LANDMARKS, Square, SquareView
from facerf_cli.portrait.segment import with_ears
from tests.portrait.seen import seen_of

EARS, HAIR, SKIN, GLASSES = (class_index(name) for name in ("ears", "hair", "skin", "glasses"))


def seen() -> SquareView:
    """A face 100 pixels large whose ears are upright lines at x 10 and x 90."""
    points = np.full((LANDMARKS, 2), 50.0)
    points[0], points[1] = (0, 0), (100, 100)
    for side, x in (("left", 10.0), ("right", 90.0)):
        for part, y in (("top", 40.0), ("back", 50.0), ("lobe", 60.0)):
            points[68 + MORE_LANDMARKS.index(f"{side} ear {part}")] = x, y
    return replace(seen_of(Square(50, 50, 170), {}), landmarks_px=points)


def lifted(shares: dict[str, float], x: float, y: float) -> torch.Tensor:
    """Shares [C] at a place, of a pixel that had some shares."""
    classes = torch.zeros(len(CLASSES), 1, 1)
    for name, share in shares.items():
        classes[class_index(name)] = share
    return with_ears(classes, seen(), np.array([[[x, y]]]))[:, 0, 0]


@pytest.mark.parametrize("x", [10.0, 90.0])
def test_a_doubtful_pixel_of_an_ear_becomes_one(x: float) -> None:
    found = lifted({"ears": 0.35, "skin": 0.45, "hair": 0.2}, x, 47)
    assert found[EARS] > 0.55 and found.sum() == pytest.approx(1, abs=1e-5)
    assert found[SKIN] / found[HAIR] == pytest.approx(0.45 / 0.2, rel=1e-4)


def test_the_odds_are_multiplied_by_one_factor() -> None:
    def odds(share: float) -> float:
        found = float(lifted({"ears": share, "skin": 1 - share}, 10, 50)[EARS])
        return found / (1 - found) / (share / (1 - share))

    assert odds(0.2) == pytest.approx(odds(0.7), rel=1e-3) and 2 < odds(0.2) < 5


def test_far_from_the_ears_nothing_changes() -> None:
    assert lifted({"ears": 0.4, "skin": 0.6}, 50, 50)[EARS] == pytest.approx(0.4, abs=1e-4)
    assert lifted({"ears": 0.4, "skin": 0.6}, 10, 90)[EARS] == pytest.approx(0.4, abs=1e-4)


def test_sure_hair_and_glasses_stay() -> None:
    assert lifted({"ears": 0.02, "hair": 0.98}, 10, 50)[HAIR] > 0.9
    assert lifted({"ears": 0.3, "glasses": 0.7}, 10, 50)[GLASSES] == pytest.approx(0.7)
