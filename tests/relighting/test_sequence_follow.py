"""A face followed from frame to frame, and bridged where it is not seen."""

import numpy as np
import pytest

from facerf_cli.face.topology import LANDMARKS_M
from facerf_cli.portrait.find import Face, face_at
from facerf_cli.relighting import sequence as follow
from facerf_cli.relighting.models import SHIPPED_NETWORKS
from facerf_cli.relighting.sequence import LONGEST_GAP, Follower, Sighting, gaps, path_of
from tests.kinds import Patch

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

    monkeypatch.setattr(follow, "face_near", nearest)
    monkeypatch.setattr(follow, "detect_faces", lambda *_, **__: now[-1])
    follower, found = Follower(SHIPPED_NETWORKS.people, which), []
    for faces in shown:
        now.append([face_at(px) for px in faces])
        seen = follower.see(BLANK)
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
