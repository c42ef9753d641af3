"""Layers lie where the network saw them; others in the photo are left out."""

from collections.abc import Sequence

import numpy as np
import pytest
import torch

from facerf_cli.image.strips import filled
from facerf_cli.portrait import segment as module
from facerf_cli.portrait.classes import CLASSES
from facerf_cli.portrait.parse import Square, SquareView
from facerf_cli.portrait.segment import Segmentation, segment
from facerf_cli.relighting.models import SHIPPED_NETWORKS
from tests.portrait.seen import places, seen_of

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
            body = ((x - 160).abs() < 50) & (y > 110)
            other = (x - 30).square() + (y - 120).square() < 20**2
            found.append(
                seen_of(square, {"garment": body, "skin": head, "hair": head & (y < 55), "hand": other})
            )
        return found

    monkeypatch.setattr(module, "look", look)
    return looked


def photo() -> np.ndarray:
    """Grey, with the person white, so that the matte's edges are the photo's."""
    y, x = np.mgrid[:HEIGHT, :WIDTH] + 0.5
    person = ((x - 160) ** 2 + (y - 70) ** 2 < 30**2) | ((abs(x - 160) < 50) & (y > 110))
    return np.repeat(np.where(person, 220, 90)[..., None], 3, -1).astype(np.uint8)


def test_layers_lie_where_the_network_saw_them(squares: list[Square]) -> None:
    found = segment(SHIPPED_NETWORKS.parsing, photo(), FACE)
    assert found.matte.shape == (HEIGHT, WIDTH)
    assert found.layer("hair")[45, 160] > 0.9 and found.layer("skin")[85, 160] > 0.9
    assert found.layer("garment")[200, 160] > 0.9 and found.matte[200, 230] < 0.1
    layers = filled(found.layers(), *found.matte.shape)
    total = sum(layers[f"class.{name}"] for name in CLASSES[1:])
    assert np.abs(total - found.matte).max() < 1e-5


def test_another_person_is_left_out(squares: list[Square]) -> None:
    found = segment(SHIPPED_NETWORKS.parsing, photo(), FACE)
    assert found.matte[120, 30] < 0.05 and found.layer("hand").max() < 0.05


def test_both_squares_show_the_face_and_the_larger_one_stays_in_the_photo(squares: list[Square]) -> None:
    segment(SHIPPED_NETWORKS.parsing, photo(), FACE)
    body, *_, near = squares
    assert near.side_px < body.side_px <= WIDTH
    for square in (body, near):
        share = square.to_share(FACE.mean(0))
        assert (share > 0.1).all() and (share < 0.9).all()
    assert body.x_px - body.side_px / 2 >= 0 and body.x_px + body.side_px / 2 <= WIDTH


def test_where_nothing_is_seen_of_a_matte_its_classes_still_sum_to_it() -> None:
    classes = torch.zeros(len(CLASSES), 8, 8)
    classes[0] = 1
    classes[:, :, 4:] = 0
    classes[CLASSES.index("hair"), :, 4:] = 1
    found = Segmentation(classes, np.full((16, 16), 0.5, np.float32))
    total = sum(found.layer(name) for name in CLASSES[1:])
    assert np.allclose(total, 0.5, atol=1e-6) and found.layer("hair").min() > 0.4


def test_what_a_thin_bridge_joins_is_left_out_and_hair_off_the_body_stays(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def look(network: object, image: np.ndarray, wanted: Sequence[Square]) -> list[SquareView]:
        found = []
        for square in wanted:
            x, y = photo_share(square)
            head = (x - 160).square() + (y - 70).square() < 40**2
            body = ((x - 160).abs() < 50) & (y > 105)
            flag = (x < 70) & (y > 150)
            bridge = (x < 160) & ((y - 180).abs() < 2.6)
            strand = ((x - 210).square() + (y - 70).square()) < 4**2
            found.append(seen_of(square, {"garment": body | flag | bridge, "skin": head, "hair": strand}))
        return found

    monkeypatch.setattr(module, "look", look)
    classes = module.seen_classes(SHIPPED_NETWORKS.parsing, photo(), FACE, module.small_image(photo()))
    matte = 1 - classes[0]
    assert matte[200, 30] < 0.05 and matte[70, 160] > 0.9 and matte[220, 160] > 0.9
    assert matte[70, 209] > 0.5


def test_the_nearest_view_weighs_most(monkeypatch: pytest.MonkeyPatch) -> None:
    def look(network: object, image: np.ndarray, wanted: Sequence[Square]) -> list[SquareView]:
        smallest = min(square.side_px for square in wanted)
        everywhere = torch.ones_like(places()[0], dtype=torch.bool)
        return [
            seen_of(square, {"skin" if square.side_px == smallest else "neck": everywhere})
            for square in wanted
        ]

    monkeypatch.setattr(module, "look", look)
    at_face = module.seen_classes(SHIPPED_NETWORKS.parsing, photo(), FACE, module.small_image(photo()))[
        :, 70, 160
    ]
    assert at_face[CLASSES.index("skin")] == pytest.approx(0.745, abs=0.01)  # 1.6^-4 over the sum
    assert at_face[CLASSES.index("neck")] > 0.2


def test_a_badge_on_the_chest_is_no_hole_and_gaps_beside_the_neck_and_an_arm_stay(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def look(network: object, image: np.ndarray, wanted: Sequence[Square]) -> list[SquareView]:
        found = []
        for square in wanted:
            x, y = photo_share(square)
            person = ((x - 160).abs() < 90) & (y > 40)
            holes = [
                (x - at_x).square() + (y - at_y).square() < 8**2
                for at_x, at_y in ((150, 180), (190, 80), (235, 180))
            ]
            found.append(seen_of(square, {"garment": person & ~torch.stack(holes).any(0)}))
        return found

    monkeypatch.setattr(module, "look", look)
    matte = 1 - module.seen_classes(SHIPPED_NETWORKS.parsing, photo(), FACE, module.small_image(photo()))[0]
    assert matte[180, 150] > 0.99 and matte[80, 190] < 0.5 and matte[180, 235] < 0.5


def test_hair_is_likelier_than_seen_and_the_matte_is_not(monkeypatch: pytest.MonkeyPatch) -> None:
    def look(network: object, image: np.ndarray, wanted: Sequence[Square]) -> list[SquareView]:
        everywhere = torch.ones_like(places()[0], dtype=torch.bool)
        found = [seen_of(square, {"hair": everywhere}) for square in wanted]
        for seen in found:
            for name, share in (("hair", 0.325), ("skin", 0.325), ("background", 0.35)):
                seen.classes[CLASSES.index(name)] = share
        return found

    monkeypatch.setattr(module, "look", look)
    at_face = module.seen_classes(SHIPPED_NETWORKS.parsing, photo(), FACE, module.small_image(photo()))[
        :, 70, 160
    ]
    assert at_face[0] == pytest.approx(0.5, abs=1e-3)
    assert at_face[CLASSES.index("hair")] / at_face[CLASSES.index("skin")] == pytest.approx(1.3, rel=1e-3)


@pytest.mark.parametrize(
    "name, share, matte",
    [
        ("hair", 0.4, 0.0), ("hair", 0.65, 0.5), ("hair", 0.9, 1.0),
        ("garment", 0.2, 0.0), ("garment", 0.5, 0.5), ("garment", 0.75, 1.0),
    ],
)  # fmt: skip
def test_a_person_is_whole_or_absent_where_it_is_fairly_sure(
    monkeypatch: pytest.MonkeyPatch, name: str, share: float, matte: float
) -> None:
    def look(network: object, image: np.ndarray, wanted: Sequence[Square]) -> list[SquareView]:
        found = [seen_of(square, {}) for square in wanted]
        for seen in found:
            seen.classes[0], seen.classes[CLASSES.index(name)] = 1 - share, share
        return found

    monkeypatch.setattr(module, "look", look)
    monkeypatch.setattr(module, "_of_one_person", lambda classes, *_: classes)
    at_chest = module.seen_classes(SHIPPED_NETWORKS.parsing, photo(), FACE, module.small_image(photo()))[
        :, 150, 160
    ]
    assert 1 - at_chest[0] == pytest.approx(matte, abs=1e-3)
    assert at_chest[CLASSES.index(name)] == pytest.approx(matte, abs=1e-3)
