"""Mattes of people: views of a photo agree with the photo, and one person is told from the next."""

import numpy as np
import pytest
import torch

from facerf_cli.face.head import OtherHead
from facerf_cli.portrait.parse import Square
from facerf_cli.portrait.people import (
    HeadPlace,
    matte_of,
    outline,
    part_of_first,
    person_among,
    with_flat_parts,
)
from tests.kinds import Patch
from tests.portrait.seen import white_people

FACE = np.random.default_rng(0).uniform([135, 45], [185, 95], (68, 2))  # around (160, 70)
HEAD = HeadPlace(160, 70, 60, 95)


def disc(x: float, y: float, radius: float, shape: tuple[int, int] = (240, 320)) -> np.ndarray:
    down, right = np.mgrid[: shape[0], : shape[1]] + 0.5
    return (right - x) ** 2 + (down - y) ** 2 < radius**2


def test_a_view_is_laid_over_where_it_was_cut_and_a_border_weighs_fully() -> None:
    y, x = np.mgrid[:120, :160] / 160
    photo = np.stack([x, y, x * y], -1).astype(np.float32)
    square = Square(70, 60, 80)
    placed, weight = square.laid_over(square.cut(photo, 256), (120, 160), photo.shape, 0.12)
    inside = weight > 0.5
    assert inside.sum() > 60**2 and (weight[:, 115:] == 0).all()
    assert np.allclose(placed.numpy()[:, inside], photo[inside].T, atol=2e-3)
    # The photo's border lies in the square's rim, where the weight would be a half.
    _, weight = Square(45, 60, 100).laid_over(torch.ones(1, 256, 256), (120, 160), (120, 160), 0.12)
    assert weight[60, 0] == 1 and weight[60, 94] < 0.1
    head = HeadPlace.of(FACE)
    half, small = head.scaled(0.5), HeadPlace.of(FACE * 0.5)
    assert vars(half) == pytest.approx(vars(small))


def test_two_people_are_divided_where_they_touch() -> None:
    first, second = disc(110, 120, 60), disc(210, 120, 60)
    image = np.where(first[..., None], [0.9, 0.2, 0.2], 0.5) * ~second[..., None] + second[..., None] * [
        0,
        0.3,
        0.9,
    ]
    heads = [HeadPlace(110, 100, 40, 120), HeadPlace(210, 100, 40, 120)]
    bodies = [disc(100, 120, 40).astype(float), disc(220, 120, 40).astype(float)]
    part = part_of_first(bodies, heads, (first | second).astype(float), image)
    assert part[120, 60] > 0.9 and part[120, 150] > 0.9 and part[120, 175] < 0.1 and part[120, 260] < 0.1


def test_each_head_of_a_crowd_is_looked_at_twice_however_many_there_are(monkeypatch: Patch) -> None:
    """Once for its own person, and once for all the others; in another image it is looked at again."""
    looks: list[HeadPlace] = []

    def person_share(network: object, image: np.ndarray, head: HeadPlace) -> np.ndarray:
        looks.append(head)
        return disc(head.x_px, head.y_px, head.height_px).astype(np.float32)

    monkeypatch.setattr("facerf_cli.portrait.people.person_share", person_share)
    monkeypatch.setattr("facerf_cli.portrait.people.body_share", person_share)
    image, parsed = np.zeros((240, 320, 3), np.float32), np.ones((240, 320), np.float32)
    landmarks_px = [FACE + np.array([x, y]) for x in (-100, 0, 100) for y in (0, 110)]
    crowd = [OtherHead(0.5 * points) for points in landmarks_px]

    def persons(crowd: list[OtherHead], image: np.ndarray) -> list[np.ndarray]:
        heads = [HeadPlace.of(points) for points in landmarks_px]
        return [
            person_among(
                white_people(), image, head, [one.scaled(2) for one in crowd if one is not crowd[n]], parsed
            ).person
            for n, head in enumerate(heads)
        ]

    together = persons(crowd, image)
    assert len(looks) == 2 * 2 * len(crowd)
    alone = [persons([OtherHead(one.landmarks_px) for one in crowd], image)[n] for n in range(len(crowd))]
    assert np.array_equal(together, alone)
    looks.clear()
    persons(crowd, image + 1)
    assert len(looks) == 2 * 2 * len(crowd)


def test_a_face_that_fills_the_photo_is_what_the_parsing_network_sees() -> None:
    parsed = disc(160, 120, 100).astype(np.float32)
    head = HeadPlace(160, 120, 320, 280)
    share = person_among(white_people(), np.zeros((240, 320, 3), np.float32), head, [], parsed).person
    assert (share == parsed).all()
    image = np.where(disc(160, 70, 55)[..., None], 1.0, 0.3).repeat(3, -1).astype(np.float32)
    share = person_among(white_people(), image, HEAD, [], np.zeros(image.shape[:2])).person
    assert share[30, 160] > 0.9 and share[100, 160] < 0.3


def test_a_plain_hat_goes_on_to_its_edge_and_what_lies_below_the_eyes_or_in_the_dark_does_not() -> None:
    """Networks are sure of the lower half of a white hat and unsure of all around the head."""
    hat, wall = disc(160, 40, 30), np.full((240, 320), 0.3)
    share = np.where(disc(160, 70, 20) | (hat & (np.arange(240)[:, None] > 35)), 0.9, wall)
    image = np.where(hat[..., None], 0.9, np.array([0.1, 0.2, 0.3]))
    found = with_flat_parts(share, image, HEAD)
    deep = disc(160, 40, 27)
    assert (found[deep] > 0.8).all() and (found[~disc(160, 40, 33)] == share[~disc(160, 40, 33)]).all()
    for other in (HeadPlace(160, -40, 60, 0), HEAD):
        darker = image if other is not HEAD else image * 0.2
        assert np.array_equal(with_flat_parts(share, darker, other), share)


def test_what_is_not_joined_to_the_face_is_nobody_and_small_holes_are_filled() -> None:
    share = (disc(160, 70, 50) | disc(30, 200, 25)).astype(float)
    share[disc(160, 80, 3)] = 0
    expected, unknown = outline(share, HEAD)
    assert expected[200, 30] == 0 and expected[80, 160] == 1
    assert unknown[70, 110] and not unknown[70, 160] and not unknown[70, 90]


@pytest.mark.parametrize("scale", [1, 6])
def test_a_matte_follows_the_edge_of_the_photo_at_its_size(scale: int) -> None:
    shape = (240 * scale, 320 * scale)
    truth = disc(160 * scale, 70 * scale, 45 * scale, shape)
    photo = np.where(truth[..., None], [220, 180, 160], [40, 60, 90]).astype(np.uint8)
    blurred = disc(160, 70, 44).astype(np.float32)  # a pixel too small
    matte = matte_of(blurred, photo, FACE * scale)
    off = np.abs(matte - truth).mean() / truth.mean()
    before = 1 - (44 / 45) ** 2
    assert matte.shape == shape and off < before / 2
