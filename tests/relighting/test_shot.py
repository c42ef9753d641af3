"""Videos: cuts, a face that is followed, one head through a shot, and smoothing."""

import gc
import weakref
from collections.abc import Sequence
from itertools import pairwise
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
import torch
from skimage.data import astronaut, coffee

from facerf_cli.errors import InputError
from facerf_cli.face.morphable import load_face_model
from facerf_cli.face.topology import LANDMARKS_M
from facerf_cli.portrait.find import Face, face_at
from facerf_cli.raster.camera import Camera, pose_to_rotation, project, rotation_to_pose
from facerf_cli.relighting import sequence
from facerf_cli.relighting.models import SHIPPED_NETWORKS, Models, Sides
from facerf_cli.relighting.sequence import (
    KEY_FRAMES,
    LONGEST_GAP,
    REACH,
    Follower,
    OnePerson,
    Sighting,
    SteadyShot,
    gaps,
    identity_of,
    path_of,
    smoothed,
    spread_over,
    steadied,
    takes,
    thumbnail,
    with_cuts,
)
from tests.kinds import Patch
from tests.refusals import refused

ONE, OTHER = astronaut()[:300, :400], coffee()[:300, :400]


def cuts_of(frames: Sequence[np.ndarray]) -> list[int]:
    return [number for number, _, cut in with_cuts(frames.__getitem__, 0, len(frames)) if cut]


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


def test_frames_are_shown_once_in_order() -> None:
    shown: list[int] = []

    def show(number: int) -> np.ndarray:
        shown.append(number)
        return np.full((12, 16, 3), number, np.uint8)

    found = list(with_cuts(show, 8, 20))
    assert [(number, int(image[0, 0, 0]), cut) for number, image, cut in found] == [
        (number, number, False) for number in range(8, 20)
    ]
    assert shown == list(range(4, 20))


@pytest.mark.parametrize(
    ("cuts", "wanted"), [([], [range(5)]), ([2], [range(2), range(2, 5)]), ([4], [range(4), range(4, 5)])]
)
def test_takes(cuts: list[int], wanted: list[range]) -> None:
    assert takes(5, cuts) == wanted


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

    monkeypatch.setattr(sequence, "face_near", nearest)
    monkeypatch.setattr(sequence, "detect_faces", lambda *_, **__: now[-1])
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
        monkeypatch.setattr(sequence, "to_display", lambda photo: photo)
        monkeypatch.setattr(sequence, "small_image", lambda photo: torch.full((3, 6, 8), 0.5))
        monkeypatch.setattr(sequence, "seen_classes", self.look)
        monkeypatch.setattr(
            sequence, "segmentation_of", lambda classes, photo, small: SimpleNamespace(classes=classes)
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
    refused(InputError, "frame 25: the face is not seen", view.segmentation, 25)


def test_key_frames_are_those_that_show_the_face(monkeypatch: Patch) -> None:
    sightings = seen(30)
    sightings[14:17] = [None] * 3  # bridged, but not to be trusted
    view = view_of(Watched(monkeypatch), sightings)
    assert len(view.key_frames) == KEY_FRAMES and not set(view.key_frames) & {14, 15, 16}
    assert view.middle == view.key_frames[2]


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


def test_maps_are_averaged_where_images_look_alike_and_kept_where_they_do_not() -> None:
    images = [torch.full((3, 20, 30), 0.5) for _ in range(3)]
    maps = [torch.full((2, 20, 30), value) for value in (0.0, 1.0, 5.0)]
    images[2][:, :, 15:] = 0.9  # another thing is seen there in the third frame
    mean = steadied(maps, images, 1)
    shares, values = torch.tensor([2 / 3, 1, 2 / 3]), torch.tensor([0.0, 1.0, 5.0])
    for part, frames in ((slice(0, 10), 3), (slice(20, 30), 2)):
        expected = float(shares[:frames] @ values[:frames] / shares[:frames].sum())
        torch.testing.assert_close(mean[:, :, part], torch.full((2, 20, 10), expected))
