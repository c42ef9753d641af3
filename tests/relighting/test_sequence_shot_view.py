"""What a frame takes from those around it, and that nothing grows with the length of a shot."""

import gc
import weakref
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
import torch

from facerf_cli.errors import InputError
from facerf_cli.relighting import sequence as shot_view
from facerf_cli.relighting.models import SHIPPED_NETWORKS, Models, Sides
from facerf_cli.relighting.sequence import KEY_FRAMES, LONGEST_GAP, Sighting, SteadyShot
from tests.kinds import Patch
from tests.relighting.test_sequence_follow import face_of

FRAMES = 60


class Watched:
    """Stands for the Parsing Network: the classes of frame n are n everywhere."""

    def __init__(self, monkeypatch: Patch) -> None:
        self.looked: list[int] = []
        self.held: list[weakref.ref[Any]] = []
        monkeypatch.setattr(shot_view, "to_display", lambda photo: photo)
        monkeypatch.setattr(shot_view, "small_image", lambda photo: torch.full((3, 6, 8), 0.5))
        monkeypatch.setattr(shot_view, "seen_classes", self.look)
        monkeypatch.setattr(
            shot_view, "segmentation_of", lambda classes, photo, small: SimpleNamespace(classes=classes)
        )

    def __getitem__(self, number: int, /) -> np.ndarray:
        photo = np.full((6, 8, 3), float(number), np.float32)
        self.held.append(weakref.ref(photo))
        return photo

    def look(
        self, parsing: object, photo: np.ndarray, landmarks_px: np.ndarray, small: torch.Tensor
    ) -> torch.Tensor:
        number = int(photo[0, 0, 0])
        self.looked.append(number)
        classes = torch.stack([torch.full((6, 8), float(number)), torch.full((6, 8), 1000.0 - number)])
        self.held.append(weakref.ref(classes))
        return classes


def view_of(watched: Watched, sightings: list[Sighting | None]) -> SteadyShot:
    return SteadyShot(
        cast(Models, SimpleNamespace(networks=SHIPPED_NETWORKS)), watched, sightings, Sides(64, 128)
    )


def seen(count: int) -> list[Sighting | None]:
    return [Sighting(face_of(40, 50), 0.01) for _ in range(count)]


def first_class(view: SteadyShot, frame: int) -> float:
    """The mean number of the frames that a frame's classes are averaged over."""
    return float(view.segmentation(frame).classes[0].mean()) * 1000


def test_each_frame_is_looked_at_once_and_little_is_kept(monkeypatch: Patch) -> None:
    watched = Watched(monkeypatch)
    view, most = view_of(watched, seen(FRAMES)), 0
    gc.freeze()  # what was there before is not looked through each time
    for frame in range(FRAMES):
        view.segmentation(frame)
        gc.collect()
        most = max(most, sum(held() is not None for held in watched.held))
    gc.unfreeze()
    assert watched.looked == list(range(FRAMES))
    assert most < FRAMES / 2


def test_a_frame_is_the_mean_of_both_sides_and_of_none_beyond_a_lost_face(monkeypatch: Patch) -> None:
    view = view_of(Watched(monkeypatch), [*seen(20), *[None] * (LONGEST_GAP + 1), *seen(20)])
    assert first_class(view, 10) == pytest.approx(10, abs=1e-3)
    assert first_class(view, 19) < 19 - 0.3  # frames after it are lost
    assert first_class(view, 20 + LONGEST_GAP + 1) > 20 + LONGEST_GAP + 1.3
    with pytest.raises(InputError, match="frame 25: the face is not seen"):
        view.segmentation(25)


def test_key_frames_are_those_that_show_the_face(monkeypatch: Patch) -> None:
    sightings = seen(30)
    sightings[14:17] = [None] * 3  # bridged, but not to be trusted
    view = view_of(Watched(monkeypatch), sightings)
    assert len(view.key_frames) == KEY_FRAMES and not set(view.key_frames) & {14, 15, 16}
    assert view.middle == view.key_frames[2]
