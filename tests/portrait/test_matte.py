"""The matte follows the photo's edges; the person's colours lose the background's."""

import numpy as np
import pytest

from facerf_cli.portrait.matte import PersonColours, lifted, solid

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
