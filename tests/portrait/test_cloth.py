"""Parts that the Parsing Network takes for skin, and that the photo's colours show to be cloth."""

import numpy as np
import pytest
import torch

from facerf_cli.image.colour import linear_to_srgb
from facerf_cli.portrait.classes import CLASSES, class_index
from facerf_cli.portrait.cloth import with_cloth
from facerf_cli.portrait.people import HeadPlace

HEAD = HeadPlace(x_px=80.0, y_px=50.0, height_px=60.0, chin_px=80.0)
# Linear sRGB
SKIN, DARK_SKIN = np.array([0.6, 0.3, 0.17]), np.array([0.08, 0.037, 0.022])
SUIT, SHIRT = np.array([0.008, 0.01, 0.02]), np.array([0.7, 0.72, 0.8])
AWAY, SMALL, CHEEK = np.s_[120:150, 20:50], np.s_[120:125, 20:25], np.s_[50:70, 65:85]


def moved(part: tuple[slice, slice], class_name: str, colour: np.ndarray, skin: np.ndarray) -> float:
    """Share of a part of some class and colour that is a garment afterwards."""
    image = np.zeros((200, 160, 3)) + SUIT
    names = np.full((200, 160), class_index("garment"))
    face = HEAD.distance((200, 160)) < 0.5
    across = np.full((200, 160, 1), 1) * np.linspace(0, 1, 160)[:, None]
    shade = (0.1 + 0.9 * across) * (1 + (across - 0.5) * (0.4, 0, -0.4))  # darker and bluer on one side
    image[face], names[face] = (skin * shade)[face], class_index("skin")
    image[part], names[part] = colour, class_index(class_name)
    face[part] = False
    shares = torch.from_numpy(np.eye(len(CLASSES), dtype=np.float32)[names]).permute(2, 0, 1)
    shares[:, part[0], part[1]] *= 0.6
    shares[class_index("garment"), part[0], part[1]] += 0.4  # which the network half sees
    given = with_cloth(shares, torch.from_numpy(linear_to_srgb(image)).float().permute(2, 0, 1), HEAD)
    torch.testing.assert_close(given.sum(0), torch.ones(200, 160))
    assert torch.equal(given[:, face], shares[:, face])
    return float((given - shares)[class_index("garment"), part[0], part[1]].mean() / 0.6)


@pytest.mark.parametrize("skin", [SKIN, DARK_SKIN])
@pytest.mark.parametrize("class_name", ["hand", "skin", "neck"])
@pytest.mark.parametrize("cloth", [SUIT, SHIRT])
def test_what_cannot_be_skin_is_cloth(skin: np.ndarray, class_name: str, cloth: np.ndarray) -> None:
    assert moved(AWAY, class_name, cloth, skin) > 0.99


@pytest.mark.parametrize("skin", [SKIN, DARK_SKIN])
@pytest.mark.parametrize("light", [1.1, 0.4, 0.1])
@pytest.mark.parametrize("redder", [-0.18, 0, 0.18])
def test_hands_in_any_light_stay(skin: np.ndarray, light: float, redder: float) -> None:
    colour = light * skin * (1 + redder, 1, 1 - redder)
    assert moved(AWAY, "hand", colour, skin) == 0


def test_paint_on_a_cheek_and_what_is_small_stay() -> None:
    assert moved(CHEEK, "skin", SHIRT, SKIN) == 0
    assert moved(SMALL, "hand", SHIRT, SKIN) == 0


def test_without_a_sure_face_nothing_changes() -> None:
    shares = torch.full((len(CLASSES), 40, 30), 1 / len(CLASSES))
    assert with_cloth(shares, torch.rand(3, 40, 30), HEAD) is shares
