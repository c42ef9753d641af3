"""Squares are cut where they lie; landmarks of mirrored images change sides."""

import math

import numpy as np
import pytest
import torch

from facerf_cli.face.crop import Crop
from facerf_cli.portrait.parse import CLASSES, LANDMARKS, MIRROR, MORE_LANDMARKS, Square, uncovered
from tests.portrait.seen import places, seen_of


def ramps(height: int, width: int) -> np.ndarray:
    """An image [H, W, 3] uint8 whose red grows to the right and whose green grows downward."""
    y, x = np.mgrid[:height, :width]
    return np.stack([x * 255 // (width - 1), y * 255 // (height - 1), 0 * x], -1).astype(np.uint8)


@pytest.mark.parametrize("turn_deg", [0, 90, -30])
@pytest.mark.parametrize("side_px", [40.0, 150.0])
def test_a_square_shows_what_lies_there(turn_deg: float, side_px: float) -> None:
    image, square = ramps(200, 300), Square(140.0, 100.0, side_px, math.radians(turn_deg))
    cut = square.cut(image, 32).numpy()
    at = (np.arange(32) + 0.5) / 32
    places = square.to_photo(np.stack(np.meshgrid(at, at), -1))
    inside = ((places > 8) & (places < [292, 192])).all(-1)
    assert np.abs(cut[0] - (places[..., 0] - 0.5) / 299)[inside].max() < 0.02
    assert np.abs(cut[1] - (places[..., 1] - 0.5) / 199)[inside].max() < 0.02
    assert np.abs(square.to_unit_square(places) - np.stack(np.meshgrid(at, at), -1)).max() < 1e-9


def test_positive_turns_borders_and_large_photos() -> None:
    right = Square(0.0, 0.0, 2.0, math.radians(30)).to_photo(np.array([1.0, 0.5]))
    assert right == pytest.approx([math.cos(math.radians(30)), -0.5])  # up on screen
    image = np.zeros((20, 20, 3), np.uint8)
    image[:, -4:] = 255
    cut = Square(30.0, 10.0, 16.0).cut(image, 8).numpy()
    assert (cut > 0.95).all()
    far = Square(300.0, -200.0, 30.0).cut(image, 8).numpy()
    assert far.shape == (3, 8, 8) and np.isfinite(far).all()
    noise = np.random.default_rng(0).integers(0, 256, (512, 512, 3)).astype(np.uint8)
    cut = Square(256.0, 256.0, 512.0).cut(noise, 16).numpy()
    assert cut.std() < 0.02 and abs(cut.mean() - 0.5) < 0.01
    mirror = MIRROR[68:] - 68
    assert (mirror[mirror] == np.arange(len(mirror))).all()
    names = dict(zip(MORE_LANDMARKS, (MORE_LANDMARKS[k] for k in mirror), strict=True))
    assert names["left ear lobe"] == "right ear lobe" and names["right iris"] == "left iris"
    assert names["left iris 0"] == "right iris 4" and names["left iris 2"] == "right iris 2"  # 0: right end
    assert names["left iris 1"] == "right iris 3"
    assert len(MIRROR) == LANDMARKS and (MIRROR[MIRROR] == np.arange(LANDMARKS)).all()


def everywhere() -> torch.Tensor:
    return torch.ones_like(places()[0], dtype=torch.bool)


def test_the_face_itself_is_uncovered_and_what_lies_before_it_covers_it() -> None:
    for name in CLASSES:
        seen = seen_of(Square(50, 50, 60), {name: everywhere()})
        own = name in ("skin", "brows", "eyes", "lips", "mouth", "beard", "ears", "neck")
        assert (uncovered(seen, Crop(30, 30, 40, 16)) == own).all(), name


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
