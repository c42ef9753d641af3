"""Mattes follow the photo's edges and divide people; their colours lose the background's."""

import numpy as np
import pytest
import torch

from facerf_cli.face.head import OtherHead
from facerf_cli.portrait.matte import (
    HeadPlace,
    PersonColours,
    enlarge_matte,
    matte_of,
    outline,
    part_of_first,
    person_among,
    solid,
    solve_matte,
    solved_before_plain_background,
    with_flat_parts,
)
from facerf_cli.portrait.parse import Square
from tests.kinds import Patch
from tests.portrait.seen import white_people

SIDE = 96


def disc(side: int, radius: float = 0.3) -> np.ndarray:
    """A disc [side, side] whose edge is a pixel wide."""
    at = (np.arange(side) + 0.5) / side - 0.5
    away = np.hypot(*np.meshgrid(at, at))
    return ((radius - away) * side + 0.5).clip(0, 1).astype(np.float32)


def photo_of(matte: np.ndarray) -> np.ndarray:
    """An orange disc over green, sRGB uint8."""
    mixed = matte[..., None] * [230, 140, 60] + (1 - matte[..., None]) * [30, 120, 70]
    return np.round(mixed).astype(np.uint8)


def test_a_small_matte_gets_the_photos_edge_and_no_pattern_where_it_is_sure() -> None:
    true, small = disc(4 * SIDE), disc(SIDE)
    large = enlarge_matte(small, photo_of(small) / np.float32(255), photo_of(true))
    assert large.shape == true.shape
    plain = np.repeat(np.repeat(small, 4, 0), 4, 1)
    assert np.abs(large - true).mean() < 0.1 * np.abs(plain - true).mean()
    pattern = np.random.default_rng(0).integers(0, 256, (SIDE, SIDE, 3)).astype(np.uint8)
    for value in (0.0, 1.0):
        sure = np.full((SIDE, SIDE), value, np.float32)
        assert (enlarge_matte(sure, pattern / np.float32(255), pattern) == value).all()


def test_skin_hides_the_background_and_ends_at_its_outline_and_hair_may_not() -> None:
    """A disc that looks like the background in a ring within its outline, without and in a haze."""
    true, ring = disc(2 * SIDE), disc(2 * SIDE, 0.2)
    clear = np.minimum(true, 0.8 + 0.2 * ring)
    loose = np.zeros((SIDE, SIDE), np.float32)
    found = solid(clear, loose)
    np.testing.assert_allclose(found[true < 0.5], clear[true < 0.5], atol=0.1)
    np.testing.assert_array_equal(found[true == 0], 0)
    guess = np.maximum(clear, np.float32(0.2))
    found = solid(guess, loose)
    inner, outer = disc(2 * SIDE, 0.24) == 1, disc(2 * SIDE, 0.36) == 0
    assert guess[inner].min() < 0.81 and found[inner].min() > 0.999
    assert guess[outer].min() > 0.19 and found[outer].max() < 0.001
    edge = (true > 0) & (true < 1)
    np.testing.assert_allclose(found[edge], guess[edge], atol=0.1)
    loose[:, : SIDE // 2] = 1
    np.testing.assert_allclose(solid(guess, loose)[:, :SIDE], guess[:, :SIDE], atol=0.1)


@pytest.mark.parametrize("loose", [0, 1])
def test_what_is_nearly_sure_of_a_matte_is_sure(loose: float) -> None:
    guess = 0.04 + 0.91 * disc(2 * SIDE)
    found = solid(guess, np.full((SIDE, SIDE), loose, np.float32))
    assert (found[guess > 0.94] == 1).all() and (found[guess < 0.05] == 0).all()


def test_an_outline_is_narrow_and_a_haze_takes_little_from_the_background() -> None:
    """The matte of a large photo rises over a tenth of it."""
    at = (np.arange(8 * SIDE) + 0.5) / (8 * SIDE) - 0.5
    slow = ((0.3 - np.hypot(*np.meshgrid(at, at))) / 0.1 + 0.5).clip(0, 1).astype(np.float32)
    found = solid(slow, np.zeros((SIDE, SIDE), np.float32))
    unsure = ((matte > 0.02) & (matte < 0.98) for matte in (found, slow))
    assert np.divide(*(part.sum() for part in unsure)) < 0.1
    assert ((found > 0.5) == (slow > 0.5)).mean() > 0.99
    # A matte of .2 over a dark background that holds nothing of the person.
    own, other = np.array([0.6, 0.3, 0.2], np.float32), np.array([0.02, 0.05, 0.01], np.float32)
    true = disc(SIDE)
    photo = true[..., None] * own + (1 - true[..., None]) * other
    matte = np.maximum(true, np.float32(0.2) * disc(SIDE, 0.34))
    haze = (true == 0) & (matte > 0.19)
    left = photo - matte[..., None] * PersonColours(photo, matte)[:]
    assert (left[haze] > 0.5 * other).all()


@pytest.mark.parametrize("value", [0.25, 0.5, 0.9])
def test_mixed_pixels_get_the_persons_colour_back(value: float) -> None:
    own, other = np.array([0.6, 0.2, 0.05]), np.array([0.05, 0.3, 0.1])
    matte = disc(SIDE)
    matte[(matte > 0) & (matte < 1)] = value
    photo = (matte[..., None] * own + (1 - matte[..., None]) * other).astype(np.float32)
    found = PersonColours(photo, matte)[:]
    edge = (matte > 0) & (matte < 1)
    assert np.abs(found[edge] - own).max() < 0.05 < np.abs(photo[edge] - own).max()
    assert (found[matte == 0] == 0).all()
    assert np.abs(found[matte == 1] - own).max() < 1e-3


@pytest.mark.parametrize("colours", [((0.9, 0.9, 0.9), (0.1, 0.1, 0.1)), ((0.2, 0.1, 0.1), (0.3, 0.8, 0.4))])
def test_shares_of_a_mixture_are_found_without_a_hint(colours: tuple[tuple[float, ...], ...]) -> None:
    x = np.linspace(-1, 2, 60)
    truth = np.tile(x.clip(0, 1), (40, 1))
    own, other = (np.array(colour, np.float32) for colour in colours)
    image = truth[..., None] * own + (1 - truth[..., None]) * other
    unknown = np.tile((x > -0.2) & (x < 1.2), (40, 1))
    expected = np.where(unknown, 0.5, truth)
    found = solve_matte(image.astype(np.float32), expected, unknown)
    # the pull toward .5 and the smoothness of windows leave a fourth of what is expected wrongly
    assert np.abs(found - truth).max() < 0.15 and np.abs(expected - truth).max() > 0.4


def test_known_pixels_stay_and_nothing_unknown_is_no_work() -> None:
    image, expected = np.random.default_rng(0).random((12, 12, 3), np.float32), np.zeros((12, 12))
    expected[:, 6:] = 1
    assert (solve_matte(image, expected, np.zeros((12, 12), bool)) == expected).all()
    unknown = np.zeros((12, 12), bool)
    unknown[:, 5:7] = True
    found = solve_matte(image, expected, unknown)
    assert (found[~unknown] == expected[~unknown]).all() and ((found >= 0) & (found <= 1)).all()


PHOTO_SIDE = 200
PERSON, WALL = np.float32([0.1, 0.06, 0.05]), np.float32([0.9, 0.9, 0.85])


def person(radius: float, soft_px: float = 3.0) -> np.ndarray:
    """A round person [PHOTO_SIDE, PHOTO_SIDE] with a soft outline."""
    y, x = np.mgrid[:PHOTO_SIDE, :PHOTO_SIDE] - PHOTO_SIDE / 2
    return np.clip((radius - np.hypot(x, y)) / soft_px + 0.5, 0, 1).astype(np.float32)


def before(alpha: np.ndarray, wall: np.ndarray) -> np.ndarray:
    return np.asarray(alpha[..., None] * PERSON + (1 - alpha[..., None]) * wall, np.float32)


def guessed() -> np.ndarray:
    """A matte that is unsure inside the outline, and hazy outside."""
    guess, y = person(60), np.arange(PHOTO_SIDE)[:, None]
    guess[(person(60) == 1) & (person(54) < 1) & (y < PHOTO_SIDE / 2)] = 0.4
    guess[(person(60) == 0) & (person(66) > 0) & (y > PHOTO_SIDE / 2)] = 0.3
    return guess


def test_before_a_plain_wall_colours_decide_and_what_is_sure_stays() -> None:
    truth, guess = person(60), guessed()
    found = solved_before_plain_background(guess, before(truth, WALL))
    assert np.abs(guess - truth).max() > 0.5
    np.testing.assert_allclose(found, truth, atol=0.03)
    # A white button near the outline, too.
    guess, image = guessed(), before(person(60), WALL)
    image[120:122, 48:50] = WALL
    assert (guess[120:122, 48:50] == 1).all()
    found = solved_before_plain_background(guess, image)
    sure = (guess == 0) | (guess == 1)
    np.testing.assert_array_equal(found[sure], guess[sure])


@pytest.mark.parametrize("kind", ["varied", "like the person"])
def test_before_a_background_that_varies_or_is_like_the_person_nothing_changes(kind: str) -> None:
    blocks = np.random.default_rng(0).random((PHOTO_SIDE // 5, PHOTO_SIDE // 5, 1), np.float32)
    varied = blocks.repeat(5, 0).repeat(5, 1) * WALL
    guess = guessed()
    found = solved_before_plain_background(guess, before(person(60), varied if kind == "varied" else PERSON))
    np.testing.assert_allclose(found, guess, atol=0.02)


FACE = np.random.default_rng(0).uniform([135, 45], [185, 95], (68, 2))  # around (160, 70)
HEAD = HeadPlace(160, 70, 60, 95)


def circle(x: float, y: float, radius: float, shape: tuple[int, int] = (240, 320)) -> np.ndarray:
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
    first, second = circle(110, 120, 60), circle(210, 120, 60)
    image = np.where(first[..., None], [0.9, 0.2, 0.2], 0.5) * ~second[..., None] + second[..., None] * [
        0,
        0.3,
        0.9,
    ]
    heads = [HeadPlace(110, 100, 40, 120), HeadPlace(210, 100, 40, 120)]
    bodies = [circle(100, 120, 40).astype(float), circle(220, 120, 40).astype(float)]
    part = part_of_first(bodies, heads, (first | second).astype(float), image)
    assert part[120, 60] > 0.9 and part[120, 150] > 0.9 and part[120, 175] < 0.1 and part[120, 260] < 0.1


def test_each_head_of_a_crowd_is_looked_at_twice_however_many_there_are(monkeypatch: Patch) -> None:
    """Once for its own person, and once for all the others; in another image it is looked at again."""
    looks: list[HeadPlace] = []

    def person_coverage(network: object, image: np.ndarray, head: HeadPlace) -> np.ndarray:
        looks.append(head)
        return circle(head.x_px, head.y_px, head.height_px).astype(np.float32)

    monkeypatch.setattr("facerf_cli.portrait.matte.person_coverage", person_coverage)
    monkeypatch.setattr("facerf_cli.portrait.matte.body_coverage", person_coverage)
    image, parsed = np.zeros((240, 320, 3), np.float32), np.ones((240, 320), np.float32)
    landmarks_px = [FACE + np.array([x, y]) for x in (-100, 0, 100) for y in (0, 110)]
    crowd = [OtherHead(0.5 * points) for points in landmarks_px]

    def persons(crowd: list[OtherHead], image: np.ndarray) -> list[np.ndarray]:
        heads = [HeadPlace.of(points) for points in landmarks_px]
        return [
            person_among(
                white_people(), image, head, [one.scaled(2) for one in crowd if one is not crowd[n]], parsed
            )[0]
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
    parsed = circle(160, 120, 100).astype(np.float32)
    head = HeadPlace(160, 120, 320, 280)
    share = person_among(white_people(), np.zeros((240, 320, 3), np.float32), head, [], parsed)[0]
    assert (share == parsed).all()
    image = np.where(circle(160, 70, 55)[..., None], 1.0, 0.3).repeat(3, -1).astype(np.float32)
    share = person_among(white_people(), image, HEAD, [], np.zeros(image.shape[:2]))[0]
    assert share[30, 160] > 0.9 and share[100, 160] < 0.3


def test_a_plain_hat_goes_on_to_its_edge_and_what_lies_below_the_eyes_or_in_the_dark_does_not() -> None:
    """Networks are sure of the lower half of a white hat and unsure of all around the head."""
    hat, wall = circle(160, 40, 30), np.full((240, 320), 0.3)
    share = np.where(circle(160, 70, 20) | (hat & (np.arange(240)[:, None] > 35)), 0.9, wall)
    image = np.where(hat[..., None], 0.9, np.array([0.1, 0.2, 0.3]))
    found = with_flat_parts(share, image, HEAD)
    deep = circle(160, 40, 27)
    assert (found[deep] > 0.8).all() and (found[~circle(160, 40, 33)] == share[~circle(160, 40, 33)]).all()
    for other in (HeadPlace(160, -40, 60, 0), HEAD):
        darker = image if other is not HEAD else image * 0.2
        assert np.array_equal(with_flat_parts(share, darker, other), share)


def test_what_is_not_joined_to_the_face_is_nobody_and_small_holes_are_filled() -> None:
    share = (circle(160, 70, 50) | circle(30, 200, 25)).astype(float)
    share[circle(160, 80, 3)] = 0
    expected, unknown = outline(share, HEAD)
    assert expected[200, 30] == 0 and expected[80, 160] == 1
    assert unknown[70, 110] and not unknown[70, 160] and not unknown[70, 90]


@pytest.mark.parametrize("scale", [1, 6])
def test_a_matte_follows_the_edge_of_the_photo_at_its_size(scale: int) -> None:
    shape = (240 * scale, 320 * scale)
    truth = circle(160 * scale, 70 * scale, 45 * scale, shape)
    photo = np.where(truth[..., None], [220, 180, 160], [40, 60, 90]).astype(np.uint8)
    blurred = circle(160, 70, 44).astype(np.float32)  # a pixel too small
    matte = matte_of(blurred, photo, FACE * scale)
    off = np.abs(matte - truth).mean() / truth.mean()
    before = 1 - (44 / 45) ** 2
    assert matte.shape == shape and off < before / 2
