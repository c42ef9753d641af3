"""Cuts, a face that is tracked, and smoothing of its path."""

from collections.abc import Sequence
from itertools import pairwise

import numpy as np
import pytest
from skimage.data import astronaut, coffee

from facerf_cli.face.topology import LANDMARKS_M
from facerf_cli.portrait.find import Face, face_at
from facerf_cli.relighting import tracking
from facerf_cli.relighting.models import SHIPPED_NETWORKS
from facerf_cli.relighting.tracking import (
    LONGEST_GAP,
    REACH,
    FaceTracker,
    Sighting,
    gaps,
    path_of,
    smoothed,
    thumbnail,
    with_cuts,
)
from tests.kinds import Patch

ONE, OTHER = astronaut()[:300, :400], coffee()[:300, :400]


def cuts_of(frames: Sequence[np.ndarray]) -> list[int]:
    return [number for number, (_, cut) in enumerate(with_cuts(frames)) if cut]


def noisy(image: np.ndarray, seed: int) -> np.ndarray:
    grain = np.random.default_rng(seed).normal(0, 12, image.shape)
    return (image + grain).clip(0, 255).astype(np.uint8)


def test_cuts_are_found_between_still_shots_and_at_both_ends() -> None:
    frames = [noisy(ONE, seed) for seed in range(6)] + [noisy(OTHER, seed) for seed in range(6)]
    assert cuts_of(frames) == [6]
    assert cuts_of([ONE, *[OTHER] * 5, ONE]) == [1, 6]
    assert cuts_of([ONE, OTHER]) == [1]
    assert cuts_of([ONE]) == []
    pans = [[image[:280, 4 * step : 4 * step + 300] for step in range(6)] for image in (ONE, OTHER)]
    assert cuts_of([*pans[0], *pans[1]]) == [6]
    assert cuts_of([*[ONE // 3] * 5, *[ONE] * 5]) == [5]


def test_a_fast_pan_a_flash_and_a_fade_are_no_cuts() -> None:
    wide = np.concatenate([astronaut(), astronaut()[:, ::-1], astronaut()], 1)
    pan = [wide[:400, 80 * step : 80 * step + 500] for step in range(12)]
    moves = [np.abs(thumbnail(a) - thumbnail(b)).mean() for a, b in pairwise(pan)]
    assert max(moves) > 0.1 and cuts_of(pan) == []
    flash = [ONE] * 4 + [np.full_like(ONE, 255)] + [ONE] * 4
    assert cuts_of(flash) == []
    shares = np.linspace(0, 1, 9)
    assert cuts_of([((1 - a) * ONE + a * OTHER).astype(np.uint8) for a in shares]) == []


def test_frames_are_shown_once_in_order_and_few_are_held() -> None:
    shown: list[int] = []

    def show(number: int) -> np.ndarray:
        shown.append(number)
        return np.full((12, 16, 3), number, np.uint8)

    for number, (image, cut) in enumerate(with_cuts(map(show, range(20)))):
        assert (int(image[0, 0, 0]), cut) == (number, False)
        assert shown == list(range(min(number + 4, 20)))


BLANK = np.zeros((100, 160, 3), np.uint8)


def face_of(x_px: float, y_px: float, side_px: float = 40.0) -> np.ndarray:
    """Landmarks [68, 2] of a face around a place."""
    flat = LANDMARKS_M[:, :2] * (1, -1)
    return (flat - flat.mean(0)) / np.ptp(flat, axis=0).max() * side_px + (x_px, y_px)


def seen_at(*places: tuple[float, float]) -> list[Sighting | None]:
    return [Sighting(face_of(*place), 0.01) for place in places]


def watch(
    monkeypatch: Patch, which: str, frames: list[list[np.ndarray]], near: bool = False
) -> list[np.ndarray | None]:
    """Follow a face through frames whose faces are given; `near` finds the nearest one without a search."""
    shown = iter(frames)
    now: list[list[Face]] = []

    def nearest(parsing: object, image: np.ndarray, last: np.ndarray) -> Face | None:
        close = [face for face in now[-1] if np.abs(face.landmarks_px.mean(0) - last.mean(0)).max() < 15]
        return close[0] if near and close else None

    monkeypatch.setattr(tracking, "face_near", nearest)
    monkeypatch.setattr(tracking, "detect_faces", lambda *_, **__: now[-1])
    tracker, found = FaceTracker(SHIPPED_NETWORKS.people, which), []
    for faces in shown:
        now.append([face_at(px) for px in faces])
        seen = tracker.track(BLANK)
        found.append(None if seen is None else seen.landmarks_px)
    return found


@pytest.mark.parametrize("near", [False, True])
@pytest.mark.parametrize(("which", "start"), [("0", 40.0), ("1", 100.0)])
def test_the_same_of_two_faces_is_followed(monkeypatch: Patch, which: str, start: float, near: bool) -> None:
    frames = [[face_of(40 + 3 * n, 50), face_of(100 - 3 * n, 40)] for n in range(8)]
    for at, found in enumerate(watch(monkeypatch, which, frames, near)):
        assert found is not None
        step = 3 * at if which == "0" else -3 * at
        assert found.mean(0)[0] == pytest.approx(start + step)


def test_a_lost_face_is_found_again_and_none_has_a_number_that_is_not_there(monkeypatch: Patch) -> None:
    own, far, small = face_of(40, 50), face_of(140, 50), face_of(42, 50, 12)
    found = watch(monkeypatch, "largest", [[own], [], [far], [small], [far, face_of(50, 52)]])
    assert [one is not None for one in found] == [True, False, False, False, True]
    assert found[-1] is not None and found[-1].mean(0)[0] == pytest.approx(50)
    assert watch(monkeypatch, "1", [[face_of(40, 50)]]) == [None]


def test_a_short_gap_is_bridged_in_a_straight_line() -> None:
    sightings = seen_at(*((10.0 + 2 * n, 50.0 - n) for n in range(30)))
    whole = path_of(sightings)
    sightings[9:14] = [None] * 5
    assert list(gaps(sightings)) == [(9, 13)]
    np.testing.assert_allclose(path_of(sightings), whole, atol=1e-6)


@pytest.mark.parametrize("first", [0, 3])
def test_a_long_gap_and_the_ends_of_a_shot_are_not_bridged(first: int) -> None:
    count = 3 if first == 0 else LONGEST_GAP + 1
    sightings: list[Sighting | None] = [None] * first if first else []
    sightings = [*seen_at(*[(40.0, 50.0)] * first), *[None] * count, *seen_at(*[(40.0, 50.0)] * 4)]
    lost = np.isnan(path_of(sightings)).all((1, 2))
    assert lost.tolist() == [first <= n < first + count for n in range(len(sightings))]


def test_a_parabola_is_kept_by_both_sides_alike_and_noise_is_not() -> None:
    time = np.arange(40.0)
    path = np.stack([0.1 * time**2 - time, 3 - 2 * time], -1)
    np.testing.assert_allclose(smoothed(path, np.ones(40)), path, atol=1e-9)
    noise = np.random.default_rng(0).normal(size=path.shape)
    left = smoothed(path + noise, np.ones(40)) - path
    assert np.abs(np.diff(left, axis=0)).mean() < 0.25 * np.abs(np.diff(noise, axis=0)).mean()
    step = (np.arange(42) >= 21).astype(float)
    there = smoothed(step, np.ones(42))
    np.testing.assert_allclose(there, 1 - there[::-1], atol=1e-9)  # a filter with delay is not symmetric
    path = 2.0 * np.arange(12)
    wrong = np.where(np.arange(12) == 5, 100.0, path)
    weights = (np.arange(12) != 5).astype(float)
    np.testing.assert_allclose(smoothed(wrong, weights), path, atol=1e-9)
    assert np.isnan(smoothed(path, np.zeros(12))).all()


@pytest.mark.parametrize("frames", [1, 2, 3, REACH])
def test_a_short_shot_is_smoothed_by_what_there_is(frames: int) -> None:
    path = 4.0 - np.arange(frames)
    np.testing.assert_allclose(smoothed(path, np.ones(frames)), path, atol=1e-9)
