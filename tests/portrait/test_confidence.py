"""Confidence of a person in a photo: what spoils it is measured, named, and takes the word down."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
import skimage.data
import torch
from scipy.ndimage import gaussian_filter
from scipy.spatial import Delaunay

from facerf_cli.errors import InputError
from facerf_cli.face.topology import LANDMARKS_M, MIRROR_68
from facerf_cli.image.colour import srgb_to_linear, to_display
from facerf_cli.portrait.confidence import (
    Confidence,
    check_seen,
    confidence_of,
    face_facts,
    given_matte_facts,
    in_hull,
    lie_on_one,
    matte_facts,
)
from facerf_cli.portrait.find import detect_faces
from facerf_cli.portrait.matte import HeadPlace
from facerf_cli.portrait.parse import LANDMARKS, Square, SquareView
from facerf_cli.raster.camera import pose_to_rotation
from facerf_cli.relighting.models import SHIPPED_NETWORKS
from tests.portrait.seen import places, seen_of
from tests.refusals import refused

SIDE_PX = 400
HEAD = HeadPlace(100, 60, 40, 80)
# A photo with all levels everywhere.
PHOTO = np.random.default_rng(0).uniform(0, 1, (SIDE_PX, SIDE_PX + 50, 3)).astype(np.float32)


def view_of_face(
    size_px: float = 200.0, error: float = 0.01, yaw_deg: float = 0.0, covered: bool = False
) -> SquareView:
    """A view of a face seen well, but for what a test changes."""
    everywhere = torch.ones_like(places()[0], dtype=torch.bool)
    middle_px = np.array([SIDE_PX / 2, SIDE_PX / 2])
    square = Square(*middle_px, 1.7 * size_px)
    seen = seen_of(square, {"hand" if covered else "skin": everywhere})
    flat = (LANDMARKS_M @ pose_to_rotation(yaw_deg, 0, 0).numpy().T)[:, :2] * [1, -1]
    points = np.zeros((LANDMARKS, 2))
    points[:68] = size_px * (flat - flat.mean(0)) / np.ptp(flat, axis=0).max() + middle_px
    return replace(seen, landmarks_px=points, error_px=np.full(LANDMARKS, error * size_px))


def test_a_good_face_is_sure_and_one_turned_too_far_doubtful() -> None:
    confidence = confidence_of(face_facts(view_of_face(), PHOTO))
    assert confidence.word == "sure" and confidence.score > 0.9 and not confidence.reasons
    words = [confidence_of(face_facts(view_of_face(yaw_deg=yaw), PHOTO)).word for yaw in (45, -57, 72)]
    assert words == ["sure", "unsure", "doubtful"]
    words = [Confidence({"small": value}).word for value in (0.9, 0.5, 0.2)]
    assert words == ["sure", "unsure", "doubtful"]
    both = Confidence({"small": 0.5, "turned": 0.4, "dark": 1.0})
    assert both.score == pytest.approx(0.2) and both.reasons == ["turned", "small"]
    photo = 0.5 + PHOTO
    photo[:20] = 100  # a window
    assert face_facts(view_of_face(), photo)["overexposed"] == 0


@pytest.mark.parametrize(
    "reason, hard",
    [
        ("small", view_of_face(size_px=24)),
        ("unclear", view_of_face(error=0.05)),
        ("turned", view_of_face(yaw_deg=80)),
        ("covered", view_of_face(covered=True)),
        ("blurred", replace(view_of_face(), sharpness=0.11)),
        ("unsteady", replace(view_of_face(), unsteadiness=0.08)),
    ],
)
def test_what_makes_a_face_hard_is_named(reason: str, hard: SquareView) -> None:
    confidence = confidence_of(face_facts(hard, PHOTO))
    assert confidence.word == "doubtful" and confidence.reasons[0] == reason


@pytest.mark.parametrize(
    "reason, photo",
    [
        ("overexposed", np.minimum(20 * PHOTO, 1)),
        ("dark", np.round(4 * PHOTO) / 4),
        ("cropped", PHOTO[: SIDE_PX // 2]),
    ],
)
def test_what_makes_a_photo_hard_is_named(reason: str, photo: np.ndarray) -> None:
    confidence = confidence_of(face_facts(view_of_face(), photo))
    assert confidence.word != "sure" and confidence.reasons[0] == reason


def disc(x: float, y: float, radius: float) -> np.ndarray:
    """A person's share [150, 220]: 1 in a disc."""
    down, right = np.mgrid[:150, :220]
    return (np.hypot(right - x, down - y) < radius).astype(np.float32)


def test_a_matte_is_disputed_where_a_network_sees_another_person_or_less_of_this_one() -> None:
    person, small = disc(100, 70, 40), disc(100, 70, 25)
    assert matte_facts(person, person, person, HEAD) == {"disputed": 1}
    others = np.maximum(person, disc(160, 70, 35))
    assert matte_facts(others, person, person, HEAD)["disputed"] < 0.9
    far = np.maximum(person, disc(210, 140, 8))
    assert matte_facts(far, person, person, HEAD) == {"disputed": 1}
    share = pytest.approx(small.sum() / person.sum())
    assert matte_facts(person, small, person, HEAD) == {"disputed": share}
    assert matte_facts(person, person, small, HEAD) == {"disputed": share}


def facts_in(photo_srgb: np.ndarray) -> dict[str, float]:
    """Facts of the face in an sRGB image [H, W, 3] with values of 0 to 255."""
    linear = srgb_to_linear(np.round(photo_srgb).astype(np.float32) / 255)
    (face,) = detect_faces(SHIPPED_NETWORKS.people, to_display(linear))
    assert face.view is not None
    return face_facts(face.view, linear)


def test_a_photo_that_is_spoiled_is_not_sure_and_says_why() -> None:
    photo = skimage.data.astronaut()[:300, 60:360].astype(np.float32)
    sound = facts_in(photo)
    assert confidence_of(sound).word == "sure"
    blurred = confidence_of(facts_in(gaussian_filter(photo, (1.9, 1.9, 0))))
    assert blurred.word != "sure" and blurred.reasons[0] == "blurred"
    clipped = 255 * np.minimum(4 * srgb_to_linear(photo / 255), 1) ** (1 / 2.2)
    assert confidence_of(facts_in(clipped)).reasons[0] == "overexposed"
    covered = photo.copy()
    covered[110:150, 140:190] = 128
    assert sound["unsteady"] < 0.012 and facts_in(covered)["unsteady"] > 1.5 * sound["unsteady"]


def test_the_hull_of_landmarks_is_that_of_their_triangles() -> None:
    random = np.random.default_rng(0)
    corners, points = random.random((68, 2)) * 0.6 + 0.2, random.random((4000, 2))
    assert np.array_equal(in_hull(points, corners), Delaunay(corners).find_simplex(points) >= 0)


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
