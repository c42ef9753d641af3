"""Landmarks and mattes that a user passes: wrong ones are refused with the likely cause, right ones pass."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from facerf_cli.errors import InputError
from facerf_cli.face.topology import LANDMARKS_M, MIRROR_68
from facerf_cli.portrait.confidence import confidence_of
from facerf_cli.portrait.given import check_seen, given_matte_facts, lie_on_one
from facerf_cli.portrait.parse import LANDMARKS, Square, SquareView
from tests.portrait.seen import places, seen_of
from tests.refusals import refused

HEIGHT, WIDTH, EXTENT = 300, 400, 80.0
FLAT = LANDMARKS_M[:, :2] * [1, -1]
FACE = EXTENT * (FLAT - FLAT.mean(0)) / np.ptp(FLAT, axis=0).max() + (120, 100)
RANDOM = np.random.default_rng(0)


def view_at(points_px: np.ndarray, sees: str = "garment", middle: str = "garment") -> SquareView:
    """A view around landmarks that shows a class everywhere, and another in the middle."""
    x, y = places()
    disc = (x - 0.5) ** 2 + (y - 0.5) ** 2 < 0.3**2
    seen = seen_of(Square.around(points_px, 1.7), {sees: x >= 0, middle: disc})
    landmarks_px = np.zeros((LANDMARKS, 2))
    landmarks_px[:68] = points_px
    return replace(seen, landmarks_px=landmarks_px)


def stored_turned(points: np.ndarray) -> np.ndarray:
    return np.stack([points[:, 1], WIDTH - points[:, 0]], 1)


@pytest.mark.parametrize(
    ("change", "cause"),
    [
        (lambda points: points / 2, "0.50 of the photo's size"),
        (lambda points: points * 1.5, "1.50 of the photo's size"),
        (lambda points: points[:, ::-1], "x and y are swapped"),
        (lambda points: points * (1, -1) + (0, HEIGHT), "y counts from the bottom"),
        (stored_turned, "EXIF"),
        (lambda points: (WIDTH, HEIGHT) - points, "EXIF"),
        (lambda points: (points * (-1, 1) + (WIDTH, 0))[MIRROR_68], "EXIF"),
        (lambda points: stored_turned(points) / 4, "EXIF ... 0.25 of the photo's size"),
    ],
)
def test_landmarks_off_the_face_are_refused_with_the_cause(
    change: Callable[[np.ndarray], np.ndarray], cause: str
) -> None:
    scattered = change(FACE + RANDOM.normal(0, 0.02 * EXTENT, FACE.shape))
    refused(InputError, cause, lie_on_one, scattered, [FACE + np.array([200, 60]), FACE], (HEIGHT, WIDTH))


def test_landmarks_of_a_face_that_only_the_user_sees_are_kept() -> None:
    """Another face is detected elsewhere; the Parsing Network decides."""
    mine = FACE + np.array([90, 70])
    assert not lie_on_one(mine, [FACE], (HEIGHT, WIDTH)) and not lie_on_one(mine, [], (HEIGHT, WIDTH))
    check_seen(view_at(mine, "background", "skin"))
    assert lie_on_one(FACE, [mine, FACE + 0.05 * EXTENT], (HEIGHT, WIDTH))
    refused(InputError, "background or clothes", check_seen, view_at(mine, "background"))


def head(radius: float = 0.3 * 1.7 * EXTENT) -> np.ndarray:
    """A matte of the head that `view_at` shows."""
    down, right = np.mgrid[:HEIGHT, :WIDTH] + 0.5
    x, y = (FACE.min(0) + FACE.max(0)) / 2
    return (np.hypot(right - x, down - y) < radius).astype(np.float32)


@pytest.mark.parametrize(
    ("matte", "cause"),
    [
        (1 - head(), "inverted"),
        (head()[::-1], "EXIF"),
        (head()[:, ::-1], "EXIF"),
        (head()[::-1, ::-1], "EXIF"),
        (np.roll(head(), 150, 1), "--face"),
        (np.zeros((HEIGHT, WIDTH), np.float32), "--face"),
    ],
)
def test_a_matte_that_masks_the_face_out_is_refused_with_the_cause(matte: np.ndarray, cause: str) -> None:
    refused(InputError, cause, given_matte_facts, view_at(FACE, "background", "skin"), matte)


def test_right_mattes_are_sure_and_one_that_hides_half_the_face_is_not() -> None:
    view, below = view_at(FACE, "background", "skin"), np.arange(HEIGHT)[:, None] > FACE[28, 1]
    everyone, white = np.maximum(head(), np.roll(head(), 150, 1)), np.ones((HEIGHT, WIDTH), np.float32)
    for matte in (head(), head(0.43 * EXTENT), head(0.61 * EXTENT), everyone, white):
        assert confidence_of(given_matte_facts(view, matte)).word == "sure"
    few = confidence_of(given_matte_facts(view, head() * (below & (np.arange(WIDTH) < FACE[30, 0]))))
    assert few.word != "sure" and few.reasons[0] == "masked"
    hand = view_at(FACE, "background", "hand")
    assert given_matte_facts(hand, 0 * head()) == {}  # no face is seen that it leaves out
