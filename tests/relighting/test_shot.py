"""One person through the frames of a shot, and maps that are smoothed over time."""

import gc
import weakref
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
import torch

from facerf_cli.errors import InputError
from facerf_cli.face.morphable import load_face_model
from facerf_cli.raster.camera import Camera, pose_to_rotation, project, rotation_to_pose
from facerf_cli.relighting import shot
from facerf_cli.relighting.models import SHIPPED_NETWORKS, Models, Sides
from facerf_cli.relighting.shot import KEY_FRAMES, OnePerson, SteadyShot, identity_of, spread_over, steadied
from facerf_cli.relighting.tracking import LONGEST_GAP, Sighting
from tests.kinds import Patch
from tests.refusals import refused
from tests.relighting.test_tracking import face_of

SIZE = (180, 240)
YAWS = (-12.0, -4.0, 3.0, 11.0)


def drawn_identity(strength: float) -> torch.Tensor:
    generator = torch.Generator().manual_seed(3)
    return strength * torch.randn(len(load_face_model("builtin").identity), generator=generator)


def frames_of_a_head(strength: float = 0.4) -> list[np.ndarray]:
    """Landmarks [68, 2] of one head that turns and opens its mouth."""
    model, alpha = load_face_model("builtin"), drawn_identity(strength)[None]
    camera = Camera(640.0, SIZE[1], SIZE[0], SIZE[1] / 2, SIZE[0] / 2)
    found = []
    for yaw, jaw in zip(YAWS, (0.0, 0.5, 1.0, 0.5), strict=True):
        beta = torch.zeros(1, len(model.expression))
        beta[0, model.expression_names.index("jaw_open")] = jaw
        vertices = model.vertices(alpha, beta)[0] @ pose_to_rotation(yaw, 2.0, 0.0).T
        points = model.landmarks(vertices[None])[0] + torch.tensor([0.0, 0.0, -1.0])
        found.append(project(points, camera).numpy().astype(np.float64))
    return found


def test_one_identity_and_the_pose_of_each_frame() -> None:
    model, frames = load_face_model("builtin"), frames_of_a_head()
    alpha = identity_of(model, frames, SIZE, 128)
    person = OnePerson(model, alpha, SIZE, 128)
    fits = [person.fit(frame) for frame in frames]
    for fit, yaw in zip(fits, YAWS, strict=True):
        torch.testing.assert_close(fit.alpha, alpha, rtol=0, atol=0)
        assert abs(rotation_to_pose(fit.rotation)[0] - yaw) < 2.5  # the crop's camera sees it a little aside
        assert fit.error_iod < 0.03 and fit.quality == "good"
        assert fit.vertices_camera(model).isfinite().all()
    jaw = model.expression_names.index("jaw_open")
    assert fits[2].beta[jaw] > fits[0].beta[jaw] + 0.2


def test_a_known_identity_explains_the_landmarks_and_key_frames_are_spread() -> None:
    model, frames = load_face_model("builtin"), frames_of_a_head(2.0)
    person = OnePerson(model, drawn_identity(2.0), SIZE, 128)
    for frame in frames:
        fit = person.fit(frame)
        found = project(model.landmarks(fit.vertices_camera(model)[None])[0], fit.camera)[17:]
        apart_px = (found - fit.landmarks_px[17:]).norm(dim=1).mean()
        assert apart_px < 0.35  # of 128; the crop's perspective is not quite the camera's
    assert spread_over([3, 4, 8, 9, 20], 3) == [3, 8, 20]
    assert spread_over(range(2), 5) == [0, 1]


FRAMES = 60


class Watched:
    """Stands for the Parsing Network: the classes of frame n are n everywhere."""

    def __init__(self, monkeypatch: Patch) -> None:
        self.looked: list[int] = []
        self.held: list[weakref.ref[Any]] = []
        monkeypatch.setattr(shot, "to_display", lambda photo: photo)
        monkeypatch.setattr(shot, "small_image", lambda photo: torch.full((3, 6, 8), 0.5))
        monkeypatch.setattr(shot, "predicted_classes", self.look)
        monkeypatch.setattr(
            shot, "segmentation_of", lambda classes, photo, small: SimpleNamespace(classes=classes)
        )

    def frame(self, number: int) -> np.ndarray:
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
        cast(Models, SimpleNamespace(networks=SHIPPED_NETWORKS)), watched.frame, sightings, Sides(64, 128)
    )


def seen(count: int) -> list[Sighting | None]:
    return [Sighting(face_of(40, 50), 0.01) for _ in range(count)]


def first_class(view: SteadyShot, frame: int) -> float:
    """Return the mean number of the frames that a frame's classes are averaged over."""
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
    refused(InputError, "frame 25:", view.segmentation, 25)


def test_key_frames_are_those_that_show_the_face(monkeypatch: Patch) -> None:
    sightings = seen(30)
    sightings[14:17] = [None] * 3  # bridged, but not to be trusted
    view = view_of(Watched(monkeypatch), sightings)
    assert len(view.key_frames) == KEY_FRAMES and not set(view.key_frames) & {14, 15, 16}
    assert view.middle == view.key_frames[2]


def test_maps_are_averaged_where_images_look_alike_and_kept_where_they_do_not() -> None:
    images = [torch.full((3, 20, 30), 0.5) for _ in range(3)]
    maps = [torch.full((2, 20, 30), value) for value in (0.0, 1.0, 5.0)]
    images[2][:, :, 15:] = 0.9  # another thing is seen there in the third frame
    mean = steadied(maps, images, 1)
    shares, values = torch.tensor([2 / 3, 1, 2 / 3]), torch.tensor([0.0, 1.0, 5.0])
    for part, frames in ((slice(0, 10), 3), (slice(20, 30), 2)):
        expected = float(shares[:frames] @ values[:frames] / shares[:frames].sum())
        torch.testing.assert_close(mean[:, :, part], torch.full((2, 20, 10), expected))
