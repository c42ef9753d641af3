"""Faces are found in small, dark, turned and large images and in tight crops; landmark files are read."""

import io
import json

import numpy as np
import pytest
import skimage.data
import skimage.transform
from PIL import Image

from facerf_cli.colour import srgb_to_linear
from facerf_cli.errors import InputError, UsageError
from facerf_cli.face.landmarks import (
    Face,
    choose_face,
    detect_landmarks,
    find_faces,
    predictor_path,
    read_landmarks,
    to_display,
)
from facerf_cli.face.topology import MIRROR_68, OUTER_EYE_CORNERS

PHOTO = skimage.data.astronaut()[:400, 40:400]  # not square


@pytest.fixture(scope="module")
def landmarks_px():
    (face,) = detect_landmarks(PHOTO)
    return face.landmarks_px


def iod_px(landmarks_px):
    left, right = OUTER_EYE_CORNERS
    return np.linalg.norm(landmarks_px[left] - landmarks_px[right])


def error_iod(found, expected):
    return np.linalg.norm(found - expected, axis=1).mean() / iod_px(expected)


def resized(image, scale):
    size = [round(length * scale) for length in image.shape[:2]]
    return np.round(255 * skimage.transform.resize(image, size, anti_aliasing=True)).astype(np.uint8)


def test_a_mirrored_photo_has_mirrored_landmarks(landmarks_px):
    (face,) = detect_landmarks(PHOTO[:, ::-1])
    back = face.landmarks_px[MIRROR_68] * [-1, 1] + [PHOTO.shape[1], 0]
    assert (back - landmarks_px).mean(0) == pytest.approx([0, 0], abs=0.25)
    assert error_iod(back, landmarks_px) < 0.02


@pytest.mark.parametrize("turns", [1, 2, 3])
def test_turned_photos(landmarks_px, turns):
    height, width = PHOTO.shape[:2]
    x, y = landmarks_px.T
    expected = {1: (y, width - x), 2: (width - x, height - y), 3: (height - y, x)}[turns]
    (face,) = detect_landmarks(np.rot90(PHOTO, turns))
    assert error_iod(face.landmarks_px, np.stack(expected, -1)) < 0.02
    left, top, right, bottom = face.box_px
    assert left < face.landmarks_px[30, 0] < right and top < face.landmarks_px[30, 1] < bottom


def test_a_badge_beside_a_sure_face_is_no_face(landmarks_px):
    (face,) = detect_landmarks(skimage.data.astronaut())  # whose sleeve badge alone the detector would take
    assert error_iod(face.landmarks_px - [40, 0], landmarks_px) < 0.02


def test_a_badge_that_the_detector_is_surer_of_through_a_jpeg(landmarks_px):
    buffer = io.BytesIO()
    Image.fromarray(skimage.data.astronaut()).save(buffer, "JPEG", quality=75)
    (face,) = detect_landmarks(np.array(Image.open(buffer)))
    assert error_iod(face.landmarks_px - [40, 0], landmarks_px) < 0.03


def test_of_two_faces_of_one_size_the_surer_is_the_largest(landmarks_px):
    doubtful, sure = (Face((0, 0, side, side), score, landmarks_px) for side, score in ((50, 0.4), (49, 1.2)))
    assert choose_face([doubtful, sure], "largest", "p") == [sure]


def test_a_small_face(landmarks_px):
    (face,) = detect_landmarks(resized(PHOTO, 0.4))
    assert error_iod(face.landmarks_px, 0.4 * landmarks_px) < 0.05


def test_a_large_image(landmarks_px):
    large = np.repeat(np.repeat(PHOTO, 10, 0), 10, 1)
    (face,) = detect_landmarks(large)
    assert error_iod(face.landmarks_px, 10 * landmarks_px) < 0.03


def test_a_tight_crop(landmarks_px):
    low, high = landmarks_px[17:].min(0).astype(int) - 8, landmarks_px[17:].max(0).astype(int) + 10
    (face,) = detect_landmarks(PHOTO[low[1] : high[1], low[0] : high[0]])
    assert error_iod(face.landmarks_px[17:] + low, landmarks_px[17:]) < 0.06


def test_a_dark_photo(landmarks_px):
    linear = srgb_to_linear(PHOTO.astype(np.float32) / 255)
    (face,) = detect_landmarks(np.round(PHOTO * 0.03).astype(np.uint8))
    assert error_iod(face.landmarks_px, landmarks_px) < 0.08
    (face,) = find_faces(linear * 1e-3, "dark.exr")
    assert error_iod(face.landmarks_px, landmarks_px) < 0.02


def test_several_faces_from_left_to_right(landmarks_px):
    small = np.zeros_like(PHOTO)
    small[100:300, 90:270] = resized(PHOTO, 0.5)
    pair = np.concatenate([small, PHOTO], 1)
    faces = detect_landmarks(pair)
    assert len(faces) == 2 and faces[0].area_px < faces[1].area_px
    assert choose_face(faces, "largest", "p") == [faces[1]] and choose_face(faces, "all", "p") == faces
    assert choose_face(faces, "0", "p") == [faces[0]]
    with pytest.raises(InputError, match="2 face"):
        choose_face(faces, "2", "p")
    for which in ("-1", "biggest", ""):
        with pytest.raises(UsageError, match="largest"):
            choose_face(faces, which, "p")


@pytest.mark.parametrize("shape", [(1, 1, 3), (1, 900, 3), (200, 300, 3)])
def test_no_face_names_the_image_and_a_way_out(shape):
    with pytest.raises(InputError, match=r"holiday\.png: no face found.*--landmarks"):
        find_faces(np.random.default_rng(0).random(shape, np.float32), "holiday.png")


def test_display_copies_are_exposed_by_themselves():
    linear = np.random.default_rng(0).random((300, 70, 3), np.float32)
    assert to_display(linear).dtype == np.uint8
    assert np.abs(to_display(linear).astype(int) - to_display(linear * 1000)).max() <= 1
    assert to_display(np.zeros((4, 5, 3), np.float32)).max() == 0


def test_only_display_images_are_searched():
    with pytest.raises(ValueError, match="uint8"):
        detect_landmarks(np.zeros((5, 5, 3), np.float32))


def test_the_predictor_is_found_without_importing_its_package():
    assert predictor_path().is_file()


def write_pts(path, points):
    rows = "\n".join(f"{x} {y}" for x, y in points)
    path.write_text(f"version: 1\nn_points: {len(points)}\n{{\n{rows}\n}}\n")
    return path


def test_files_of_landmarks(tmp_path, landmarks_px):
    pts = write_pts(tmp_path / "a.pts", landmarks_px + 0.5)  # iBUG counts the first pixel's centre as 1
    assert read_landmarks(pts) == pytest.approx(landmarks_px)
    for content in (landmarks_px.tolist(), {"landmarks": landmarks_px.tolist()}):
        (tmp_path / "a.json").write_text(json.dumps(content))
        assert read_landmarks(tmp_path / "a.json") == pytest.approx(landmarks_px)


@pytest.mark.parametrize(
    "name, text",
    [
        ("a.pts", "version: 1\n1 2\n3 4"),
        ("a.pts", "{\n1 2 3\n}"),
        ("a.pts", "{\n1 x\n}"),
        ("a.json", "[[1, 2], [3]]"),
        ("a.json", '{"points": []}'),
        ("a.json", "nonsense"),
        ("a.json", json.dumps([[1, 2]] * 68)),
        ("a.json", json.dumps([[float("nan"), 2]] * 68)),
        ("a.json", "[" * 100000),
        ("a.json", "1" * (1 << 21)),
        ("a.json", '{"landmarks": "abc"}'),
    ],
)
def test_bad_files_are_named(tmp_path, name, text):
    (tmp_path / name).write_text(text)
    with pytest.raises(InputError, match=name):
        read_landmarks(tmp_path / name)


def test_missing_and_binary_files_are_named(tmp_path):
    (tmp_path / "b.json").write_bytes(bytes(range(256)))
    for name in ("b.json", "missing.pts"):
        with pytest.raises(InputError, match=name):
            read_landmarks(tmp_path / name)
