"""The skin of a face is what shows it: not hands, hair or glasses, wherever the crop lies."""

import math

import pytest
import torch

from facerf_cli.face.crop import Crop
from facerf_cli.portrait.parse import Square, uncovered
from tests.portrait.seen import places, seen_of


def everywhere() -> torch.Tensor:
    return torch.ones_like(places()[0], dtype=torch.bool)


@pytest.mark.parametrize("name", ["skin", "brows", "eyes", "lips", "mouth", "beard", "ears", "neck"])
def test_the_face_itself_is_uncovered(name: str) -> None:
    seen = seen_of(Square(50, 50, 60), {name: everywhere()})
    assert (uncovered(seen, Crop(30, 30, 40, 16)) == 1).all()


@pytest.mark.parametrize("name", ["hair", "glasses", "headwear", "garment", "hand", "background"])
def test_what_lies_before_it_covers_it(name: str) -> None:
    seen = seen_of(Square(50, 50, 60), {name: everywhere()})
    assert (uncovered(seen, Crop(30, 30, 40, 16)) == 0).all()


@pytest.mark.parametrize("turn_deg", [0, 90])
def test_a_hand_covers_its_own_place_in_the_photo(turn_deg: float) -> None:
    x, _ = places()
    seen = seen_of(Square(50, 40, 40, math.radians(turn_deg)), {"skin": everywhere(), "hand": x < 0.5})
    crop = Crop(10, 0, 80, 80)  # pixel (column, row) shows the photo at (10 + column, row)
    shown = uncovered(seen, crop)
    left, below = shown[30:50, 22:38], shown[42:58, 30:50]
    assert (left == 0).all() if turn_deg == 0 else (below == 0).all()
    right, above = shown[30:50, 42:58], shown[22:38, 30:50]
    assert (right == 1).all() if turn_deg == 0 else (above == 1).all()
    assert (shown[:, :15] == 1).all()  # beyond the square nothing is known
