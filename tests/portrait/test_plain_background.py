"""A matte that colours alone decide, before a plain background."""

import numpy as np
import pytest

from facerf_cli.portrait.matte import solved_before_plain_background

SIDE = 200
PERSON, WALL = np.float32([0.1, 0.06, 0.05]), np.float32([0.9, 0.9, 0.85])


def disc(radius: float, soft_px: float = 3.0) -> np.ndarray:
    """A round person [SIDE, SIDE] with a soft outline."""
    y, x = np.mgrid[:SIDE, :SIDE] - SIDE / 2
    return np.clip((radius - np.hypot(x, y)) / soft_px + 0.5, 0, 1).astype(np.float32)


def seen(alpha: np.ndarray, wall: np.ndarray) -> np.ndarray:
    return np.asarray(alpha[..., None] * PERSON + (1 - alpha[..., None]) * wall, np.float32)


def guessed() -> np.ndarray:
    """A matte that is unsure inside the outline, and hazy outside."""
    guess, y = disc(60), np.arange(SIDE)[:, None]
    guess[(disc(60) == 1) & (disc(54) < 1) & (y < SIDE / 2)] = 0.4
    guess[(disc(60) == 0) & (disc(66) > 0) & (y > SIDE / 2)] = 0.3
    return guess


def test_before_a_plain_wall_colours_decide_and_what_is_sure_stays() -> None:
    truth, guess = disc(60), guessed()
    found = solved_before_plain_background(guess, seen(truth, WALL))
    assert np.abs(guess - truth).max() > 0.5
    np.testing.assert_allclose(found, truth, atol=0.03)
    # A white button near the outline, too.
    guess, image = guessed(), seen(disc(60), WALL)
    image[120:122, 48:50] = WALL
    assert (guess[120:122, 48:50] == 1).all()
    found = solved_before_plain_background(guess, image)
    sure = (guess == 0) | (guess == 1)
    np.testing.assert_array_equal(found[sure], guess[sure])


@pytest.mark.parametrize("kind", ["varied", "like the person"])
def test_before_a_background_that_varies_or_is_like_the_person_nothing_changes(kind: str) -> None:
    blocks = np.random.default_rng(0).random((SIDE // 5, SIDE // 5, 1), np.float32)
    varied = blocks.repeat(5, 0).repeat(5, 1) * WALL
    guess = guessed()
    found = solved_before_plain_background(guess, seen(disc(60), varied if kind == "varied" else PERSON))
    np.testing.assert_allclose(found, guess, atol=0.02)
