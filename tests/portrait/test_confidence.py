"""Confidence falls with each thing that makes a photo hard, and names it."""

from dataclasses import replace

import numpy as np
import pytest
import skimage.data
import torch
from scipy.ndimage import gaussian_filter

from facerf_cli.face.topology import LANDMARKS_M
from facerf_cli.portrait.find import Confidence, confidence_in, detect_faces
from facerf_cli.portrait.parse import LANDMARKS, Square, SquareView
from facerf_cli.relighting.models import SHIPPED_NETWORKS
from tests.portrait.seen import places, seen_of


def face(
    size_px: float = 300.0,
    error: float = 0.01,
    turned: float = 1.0,
    covered: bool = False,
    presence: float = 1.0,
) -> SquareView:
    """A face seen well, but for what a test changes; `turned` narrows it."""
    everywhere = torch.ones_like(places()[0], dtype=torch.bool)
    seen = seen_of(Square(0, 0, 2 * size_px), {"hand" if covered else "skin": everywhere}, presence)
    flat = LANDMARKS_M[:, :2] * [turned, -1]
    points = np.zeros((LANDMARKS, 2))
    points[:68] = size_px * flat / np.ptp(flat, axis=0).max()
    return replace(seen, landmarks_px=points, error_px=np.full(LANDMARKS, error * size_px))


def test_a_good_face_is_sure() -> None:
    confidence = confidence_in(face())
    assert confidence.word == "sure" and confidence.score > 0.9


@pytest.mark.parametrize(
    "reason, hard",
    [
        ("small", face(size_px=45)),
        ("unclear", face(error=0.05)),
        ("unclear", face(presence=0.2)),
        ("profile", face(turned=0.2)),
        ("covered", face(covered=True)),
        ("blurred", replace(face(), sharpness=0.13)),
    ],
)
def test_what_makes_a_photo_hard_is_named(reason: str, hard: SquareView) -> None:
    confidence = confidence_in(hard)
    assert confidence.word == "doubtful" and confidence.reason == reason


def test_a_head_that_is_turned_too_far_is_doubtful() -> None:
    assert confidence_in(face(), -45.0).score == confidence_in(face()).score
    turned = confidence_in(face(), -72.0)
    assert turned.word == "doubtful" and turned.reason == "turned"


def test_the_words_follow_the_score() -> None:
    words = [Confidence({"small": value}).word for value in (0.9, 0.5, 0.2)]
    assert words == ["sure", "unsure", "doubtful"]
    assert Confidence({"small": 0.5, "profile": 0.5}).score == pytest.approx(0.25)


def test_a_blurred_photo_is_doubtful_and_says_why() -> None:
    photo = skimage.data.astronaut()[:300, 60:360].astype(np.float32)
    (sharp,) = detect_faces(SHIPPED_NETWORKS.parsing, photo.astype(np.uint8))
    assert sharp.view is not None and confidence_in(sharp.view).factors["blurred"] == 1
    blurs = [0.01 * sharp.view.extent_px, 0.02 * sharp.view.extent_px]
    found = [
        detect_faces(SHIPPED_NETWORKS.parsing, gaussian_filter(photo, (blur, blur, 0)).astype(np.uint8))[0]
        for blur in blurs
    ]
    little, much = (confidence_in(one.view) for one in found if one.view)
    assert little.factors["blurred"] > 0.5 > much.factors["blurred"]
    assert much.word != "sure" and much.reason == "blurred"
