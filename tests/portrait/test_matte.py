"""The matte follows the photo's edges; the person's colours lose the background's."""

import numpy as np
import pytest

from facerf_cli.portrait.matte import (
    PersonColours,
    lifted,
    solid,
    solve_matte,
    solved_before_plain_background,
)

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
    large = lifted(small, photo_of(small) / np.float32(255), photo_of(true))
    assert large.shape == true.shape
    plain = np.repeat(np.repeat(small, 4, 0), 4, 1)
    assert np.abs(large - true).mean() < 0.1 * np.abs(plain - true).mean()
    pattern = np.random.default_rng(0).integers(0, 256, (SIDE, SIDE, 3)).astype(np.uint8)
    for value in (0.0, 1.0):
        sure = np.full((SIDE, SIDE), value, np.float32)
        assert (lifted(sure, pattern / np.float32(255), pattern) == value).all()


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
