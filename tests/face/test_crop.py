"""Crops lie where they say, filter what they shrink, and hold the whole face."""

import numpy as np
import pytest
import torch

from facerf_cli.errors import InputError
from facerf_cli.face.crop import Crop, check_in_photo, from_box, from_landmarks
from facerf_cli.face.topology import LANDMARKS_M
from tests.refusals import refused


def dot(height: int, width: int, x_px: float, y_px: float, sigma_px: float) -> np.ndarray:
    """A soft dot [H, W, 1] centred at a pixel position."""
    y, x = np.mgrid[:height, :width] + 0.5
    return np.exp(-((x - x_px) ** 2 + (y - y_px) ** 2) / (2 * sigma_px**2))[..., None]


def centroid_px(image: np.ndarray) -> np.ndarray:
    y, x = np.mgrid[: image.shape[0], : image.shape[1]] + 0.5
    return np.array([(x * image[..., 0]).sum(), (y * image[..., 0]).sum()]) / image.sum()


def frontal_landmarks(scale_px: float = 1000.0, turn_deg: float = 0.0) -> np.ndarray:
    """The mean's landmarks seen from far in front, rotated in the image."""
    flat = LANDMARKS_M[:, :2] * [scale_px, -scale_px]
    c, s = np.cos(np.radians(turn_deg)), np.sin(np.radians(turn_deg))
    return flat @ np.array([[c, s], [-s, c]]) + [300, 200]


@pytest.mark.parametrize("size_px", [40, 97, 256])
def test_a_dot_lands_where_the_transform_says(size_px):
    crop = Crop(13.3, 7.7, 88.4, size_px)
    image = dot(110, 140, 51.2, 60.9, 4.0)
    assert centroid_px(crop.apply(image)) == pytest.approx(crop.to_crop(np.array([51.2, 60.9])), abs=0.01)


def test_crops_copy_average_and_keep_to_the_range_of_the_image():
    image = np.random.default_rng(0).random((30, 45, 3), np.float32)
    assert Crop(7, 4, 20, 20).apply(image) == pytest.approx(image[4:24, 7:27], abs=1e-6)
    board = (np.indices((200, 260)).sum(0) % 2).astype(np.float32)[..., None]
    assert np.ptp(Crop(20, 10, 150, 41).apply(board)) < 0.02
    image = np.zeros((20, 30, 3), np.float32)
    image[10, 15] = 1e4
    cut = Crop(5, 2, 16, 128).apply(image)
    assert cut.min() == 0 and cut.max() <= 1e4
    crop = Crop(-20.5, 31.0, 333.0, 256)
    points = np.random.default_rng(0).uniform(-50, 400, (9, 2))
    assert crop.to_photo(crop.to_crop(points)) == pytest.approx(points)
    assert crop.to_crop(np.array([-20.5, 31.0])) == pytest.approx([0, 0])
    assert crop.camera.focal_px == 4 * 256


@pytest.mark.parametrize("size_px, off_px", [(33, 0.03), (50, 1e-4), (170, 1e-4)])
def test_ramps_stay_straight(size_px, off_px):
    y, x = np.mgrid[:80, :100] + 0.5
    crop = Crop(20, 15, 50, size_px)
    cut = crop.apply(np.stack([x, y], -1))
    centres = np.arange(size_px) + 0.5
    expected = crop.to_photo(np.stack(np.meshgrid(centres, centres), -1))
    assert cut == pytest.approx(expected, abs=off_px)


def test_beyond_the_border_the_edge_goes_on_and_is_marked():
    image = np.random.default_rng(0).random((12, 20, 1), np.float32)
    crop = Crop(-8, -4, 32, 32)
    cut, valid = crop.apply(image), crop.valid(12, 20)
    assert valid.sum() == 12 * 20 and valid[4:16, 8:28].all()
    assert cut[:4, 8:28] == pytest.approx(np.repeat(cut[4:5, 8:28], 4, 0), abs=1e-6)
    assert cut[31, 31] == pytest.approx(image[-1, -1], abs=1e-6)
    image = np.full((10, 10, 3), 0.25, np.float32)
    assert Crop(50, 50, 10, 8).apply(image) == pytest.approx(np.full((8, 8, 3), 0.25))


@pytest.mark.parametrize("turn_deg", [0, 30, 90, 180, 270])
def test_chin_and_forehead_fit_however_the_head_lies(turn_deg):
    landmarks = frontal_landmarks(turn_deg=turn_deg)
    crop = from_landmarks(landmarks, 256)
    head = np.array([[0, 0.092], [-0.07, 0.085], [0.07, 0.085], [0, -0.082]])  # the grid's top and bottom
    c, s = np.cos(np.radians(turn_deg)), np.sin(np.radians(turn_deg))
    head_px = crop.to_crop((head * [1000, -1000]) @ np.array([[c, s], [-s, c]]) + [300, 200])
    inside = np.concatenate([crop.to_crop(landmarks), head_px])
    assert inside.min() > 4 and inside.max() < 252


def test_the_crop_follows_the_face_and_that_of_a_box_is_larger():
    plain, moved = from_landmarks(frontal_landmarks(), 256), from_landmarks(2 * frontal_landmarks(), 256)
    assert moved.side_px == pytest.approx(2 * plain.side_px)
    assert moved.x0_px == pytest.approx(2 * plain.x0_px)
    # A detector's box holds brows to chin; the spans are measured.
    crop = from_box((100.0, 40.0, 200.0, 140.0), 64)
    assert crop == Crop(150 - 74, 90 - 2 - 74, 148, 64)
    for bad in ((5.0, 0.0, 5.0, 0.0), (0.0, 0.0, np.inf, 9.0), (0.0, 0.0, np.nan, 9.0)):
        refused(InputError, "not a face box", from_box, bad, 64)


def test_tensors_and_crops_of_another_world_are_refused():
    refused(ValueError, "[H, W, C]", Crop(0, 0, 8, 8).apply, torch.zeros(8, 8).numpy())
    # Points far outside the photo once took 23 GB: the weights grow with the crop's side.
    refused(InputError, "pixels wide", Crop(0, 0, 1e8, 8).apply, np.ones((12, 9, 3), np.float32))


@pytest.mark.parametrize("place", [lambda px: px + 1e6, lambda px: px * 1e6, lambda px: px - 2000])
def test_landmarks_of_another_photo_are_refused(place):
    height, width = 500, 620
    landmarks = frontal_landmarks()
    assert check_in_photo(landmarks, height, width) is landmarks
    refused(InputError, "outside the image", check_in_photo, place(landmarks), height, width)
