"""Layers lie where the network saw them; others in the photo are left out."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
import torch

from facerf_cli.image.colour import linear_to_srgb
from facerf_cli.image.strips import in_strips
from facerf_cli.network.stored_graph import PeopleNetworks
from facerf_cli.portrait import segment as module
from facerf_cli.portrait.matte import HeadPlace
from facerf_cli.portrait.parse import CLASSES, LANDMARKS, MORE_LANDMARKS, Square, SquareView, class_index
from facerf_cli.portrait.segment import Segmentation, segment, with_cloth, with_ears
from tests.portrait.seen import places, seen_of, white_people

HEIGHT, WIDTH = 240, 320
FACE = np.random.default_rng(0).uniform([135, 45], [185, 95], (68, 2))  # around (160, 70), 50 pixels large


def photo_share(square: Square) -> tuple[torch.Tensor, torch.Tensor]:
    """Where in the photo the pixels of a square lie, in pixels."""
    x, y = places()
    at = square.to_photo(torch.stack([x, y], -1).numpy())
    return torch.from_numpy(at[..., 0]), torch.from_numpy(at[..., 1])


@pytest.fixture
def squares(monkeypatch: pytest.MonkeyPatch) -> list[Square]:
    """A network that sees a head, a garment below it, and another person on the left."""
    looked: list[Square] = []

    def look(network: object, image: np.ndarray, wanted: Sequence[Square]) -> list[SquareView]:
        looked.extend(wanted)
        found = []
        for square in wanted:
            x, y = photo_share(square)
            head = (x - 160).square() + (y - 70).square() < 30**2
            body = ((x - 160).abs() < 50) & (y > 98)
            other = (x - 30).square() + (y - 120).square() < 20**2
            found.append(
                seen_of(square, {"garment": body, "skin": head, "hair": head & (y < 55), "hand": other})
            )
        return found

    monkeypatch.setattr(module, "look", look)
    return looked


@pytest.fixture
def people(monkeypatch: pytest.MonkeyPatch) -> PeopleNetworks:
    """Networks that take what is white for a person, and see no further face and no body."""
    monkeypatch.setattr(module, "find_meshes", lambda *_: [])
    return white_people()


def photo() -> np.ndarray:
    """Grey, with the person white, so that the matte's edges are the photo's."""
    y, x = np.mgrid[:HEIGHT, :WIDTH] + 0.5
    person = ((x - 160) ** 2 + (y - 70) ** 2 < 30**2) | ((abs(x - 160) < 50) & (y > 98))
    return np.repeat(np.where(person, 220, 90)[..., None], 3, -1).astype(np.uint8)


def test_layers_lie_where_the_network_saw_them(squares: list[Square], people: PeopleNetworks) -> None:
    found = segment(people, photo(), FACE)
    assert found.matte.shape == (HEIGHT, WIDTH)
    assert found.layer("hair")[45, 160] > 0.9 and found.layer("skin")[85, 160] > 0.9
    assert found.layer("garment")[200, 160] > 0.9 and found.matte[200, 230] < 0.1
    layers = in_strips(found.layers, *found.matte.shape)
    total = sum(layers[f"class.{name}"] for name in CLASSES[1:])
    assert np.abs(total - found.matte).max() < 1e-5


def test_a_given_matte_is_the_persons_and_its_classes_are_completed(
    squares: list[Square], people: PeopleNetworks
) -> None:
    matte = np.zeros((HEIGHT, WIDTH), np.float32)
    matte[20:220, 70:250] = 0.5
    found = segment(people, photo(), FACE, matte)
    assert found.matte is matte
    layers = in_strips(found.layers, *matte.shape)
    assert np.abs(sum(layers[f"class.{name}"] for name in CLASSES[1:]) - matte).max() < 1e-5
    seen, completed = layers["class.garment"][200, 160], layers["class.garment"][200, 80]
    assert seen == pytest.approx(0.5, abs=0.02) and completed == pytest.approx(0.5, abs=0.02)


def test_both_squares_show_the_face_and_the_larger_one_stays_in_the_photo(
    squares: list[Square], people: PeopleNetworks
) -> None:
    segment(people, photo(), FACE)
    body, *_, near = squares
    assert near.side_px < body.side_px <= WIDTH
    for square in (body, near):
        share = square.to_unit_square(FACE.mean(0))
        assert (share > 0.1).all() and (share < 0.9).all()
    assert body.x_px - body.side_px / 2 >= 0 and body.x_px + body.side_px / 2 <= WIDTH


def test_every_pixel_of_the_person_has_a_class_that_sums_to_the_matte(
    squares: list[Square], people: PeopleNetworks
) -> None:
    classes = torch.zeros(len(CLASSES), 8, 8)
    classes[0] = 1
    classes[:, :, 4:] = 0
    classes[CLASSES.index("hair"), :, 4:] = 1
    found = Segmentation(classes, np.full((16, 16), 0.5, np.float32))
    total = sum(found.layer(name) for name in CLASSES[1:])
    assert np.allclose(total, 0.5, atol=1e-6) and found.layer("hair").min() > 0.4
    # A hat that the Parsing Network does not see has the class of the nearest pixel that it sees.
    image = photo()
    image[10:40, 140:180] = 220
    found = segment(people, image, FACE)
    assert found.matte[20, 160] > 0.9 and found.layer("hair")[20, 160] > 0.9


EARS, HAIR, SKIN, GLASSES = (class_index(name) for name in ("ears", "hair", "skin", "glasses"))


def ears_seen() -> SquareView:
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
    return with_ears(classes, ears_seen(), np.array([[[x, y]]]))[:, 0, 0]


@pytest.mark.parametrize("x", [10.0, 90.0])
def test_a_doubtful_pixel_of_an_ear_becomes_one(x: float) -> None:
    found = lifted({"ears": 0.35, "skin": 0.45, "hair": 0.2}, x, 47)
    assert found[EARS] > 0.55 and found.sum() == pytest.approx(1, abs=1e-5)
    assert found[SKIN] / found[HAIR] == pytest.approx(0.45 / 0.2, rel=1e-4)


def test_the_odds_are_multiplied_by_one_factor_near_the_ears_alone() -> None:
    def odds(share: float) -> float:
        found = float(lifted({"ears": share, "skin": 1 - share}, 10, 50)[EARS])
        return found / (1 - found) / (share / (1 - share))

    assert odds(0.2) == pytest.approx(odds(0.7), rel=1e-3) and 2 < odds(0.2) < 5
    assert lifted({"ears": 0.4, "skin": 0.6}, 50, 50)[EARS] == pytest.approx(0.4, abs=1e-4)
    assert lifted({"ears": 0.4, "skin": 0.6}, 10, 90)[EARS] == pytest.approx(0.4, abs=1e-4)
    assert lifted({"ears": 0.02, "hair": 0.98}, 10, 50)[HAIR] > 0.9
    assert lifted({"ears": 0.3, "glasses": 0.7}, 10, 50)[GLASSES] == pytest.approx(0.7)


HEAD = HeadPlace(x_px=80.0, y_px=50.0, height_px=60.0, chin_px=80.0)
# Linear sRGB
SKIN_RGB, DARK_SKIN = np.array([0.6, 0.3, 0.17]), np.array([0.08, 0.037, 0.022])
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


@pytest.mark.parametrize("skin", [SKIN_RGB, DARK_SKIN])
@pytest.mark.parametrize("class_name", ["hand", "skin", "neck"])
@pytest.mark.parametrize("cloth", [SUIT, SHIRT])
def test_what_cannot_be_skin_is_cloth(skin: np.ndarray, class_name: str, cloth: np.ndarray) -> None:
    assert moved(AWAY, class_name, cloth, skin) > 0.99


@pytest.mark.parametrize("skin", [SKIN_RGB, DARK_SKIN])
@pytest.mark.parametrize("light", [1.1, 0.4, 0.1])
@pytest.mark.parametrize("redder", [-0.18, 0, 0.18])
def test_hands_in_any_light_stay(skin: np.ndarray, light: float, redder: float) -> None:
    colour = light * skin * (1 + redder, 1, 1 - redder)
    assert moved(AWAY, "hand", colour, skin) == 0


def test_paint_on_a_cheek_and_what_is_small_stay() -> None:
    assert moved(CHEEK, "skin", SHIRT, SKIN_RGB) == 0
    assert moved(SMALL, "hand", SHIRT, SKIN_RGB) == 0


def test_without_a_sure_face_nothing_changes() -> None:
    shares = torch.full((len(CLASSES), 40, 30), 1 / len(CLASSES))
    assert with_cloth(shares, torch.rand(3, 40, 30), HEAD) is shares
