"""Faces are found in small, dark, turned and large images and in tight crops."""

import io

import numpy as np
import pytest
import skimage.data
import skimage.transform
from PIL import Image

from facerf_cli.errors import InputError
from facerf_cli.face.topology import CONTOUR, MIRROR_68, OUTER_EYE_CORNERS
from facerf_cli.image.colour import srgb_to_linear
from facerf_cli.portrait.find import detect_faces, find_faces
from facerf_cli.relighting.models import SHIPPED_NETWORKS

PHOTO = skimage.data.astronaut()[:400, 40:400]  # not square
INNER = slice(len(CONTOUR), None)
MARKED_PX = {  # where a person sees them: corners of eyes and mouth, tip of the nose, chin
    36: (154, 101), 39: (171, 103), 42: (198, 105), 45: (218, 105),
    30: (184, 125), 48: (164, 140), 54: (203, 141), 8: (183, 178),
}  # fmt: skip


@pytest.fixture(scope="module")
def landmarks_px():
    (face,) = detect_faces(SHIPPED_NETWORKS.people, PHOTO)
    return face.landmarks_px


def iod_px(landmarks_px):
    left, right = OUTER_EYE_CORNERS
    return np.linalg.norm(landmarks_px[left] - landmarks_px[right])


def error_iod(found, expected):
    return np.linalg.norm(found - expected, axis=1).mean() / iod_px(expected)


def resized(image, scale):
    size = [round(length * scale) for length in image.shape[:2]]
    return np.round(255 * skimage.transform.resize(image, size, anti_aliasing=True)).astype(np.uint8)


def test_landmarks_lie_where_a_person_marks_them_in_large_small_tight_and_dark_photos(landmarks_px):
    off_px = np.linalg.norm(landmarks_px[list(MARKED_PX)] - list(MARKED_PX.values()), axis=1)
    assert off_px.max() < 0.06 * iod_px(landmarks_px)
    (face,) = detect_faces(SHIPPED_NETWORKS.people, PHOTO[:, ::-1])
    back = face.landmarks_px[MIRROR_68] * [-1, 1] + [PHOTO.shape[1], 0]
    assert (back - landmarks_px).mean(0) == pytest.approx([0, 0], abs=0.25)
    assert error_iod(back, landmarks_px) < 0.02
    buffer = io.BytesIO()
    Image.fromarray(skimage.data.astronaut()).save(buffer, "JPEG", quality=75)
    (face,) = detect_faces(SHIPPED_NETWORKS.people, np.array(Image.open(buffer)))
    assert error_iod(face.landmarks_px - [40, 0], landmarks_px) < 0.03
    (face,) = detect_faces(SHIPPED_NETWORKS.people, resized(PHOTO, 0.4))
    assert error_iod(face.landmarks_px, 0.4 * landmarks_px) < 0.05
    large = np.repeat(np.repeat(PHOTO, 10, 0), 10, 1)
    (face,) = detect_faces(SHIPPED_NETWORKS.people, large)
    assert error_iod(face.landmarks_px, 10 * landmarks_px) < 0.03
    low, high = landmarks_px[17:].min(0).astype(int) - 8, landmarks_px[17:].max(0).astype(int) + 10
    (face,) = detect_faces(SHIPPED_NETWORKS.people, PHOTO[low[1] : high[1], low[0] : high[0]])
    assert error_iod(face.landmarks_px[17:] + low, landmarks_px[17:]) < 0.06
    linear = srgb_to_linear(PHOTO.astype(np.float32) / 255)
    (face,) = detect_faces(SHIPPED_NETWORKS.people, np.round(PHOTO * 0.03).astype(np.uint8))
    assert error_iod(face.landmarks_px, landmarks_px) < 0.08
    (face,) = find_faces(SHIPPED_NETWORKS.people, linear * 1e-3, "dark.exr")
    assert error_iod(face.landmarks_px, landmarks_px) < 0.02


@pytest.mark.parametrize("turns", [1, 2])
def test_turned_photos(landmarks_px, turns):
    height, width = PHOTO.shape[:2]
    x, y = landmarks_px.T
    expected = {1: (y, width - x), 2: (width - x, height - y)}[turns]
    (face,) = detect_faces(SHIPPED_NETWORKS.people, np.rot90(PHOTO, turns))
    assert error_iod(face.landmarks_px, np.stack(expected, -1)) < 0.05
    left, top, right, bottom = face.box_px
    assert left < face.landmarks_px[30, 0] < right and top < face.landmarks_px[30, 1] < bottom


@pytest.mark.slow
def test_several_faces_from_left_to_right_and_one_of_24_pixels(landmarks_px):
    small = np.zeros_like(PHOTO)
    small[100:300, 90:270] = resized(PHOTO, 0.5)
    pair = np.concatenate([small, PHOTO], 1)
    faces = detect_faces(SHIPPED_NETWORKS.people, pair)
    assert len(faces) == 2 and faces[0].area_px < faces[1].area_px
    assert [face.number for face in faces] == [0, 1]
    assert len(detect_faces(SHIPPED_NETWORKS.people, pair, everyone=True)) == 2
    for a, b in (faces, faces[::-1]):
        assert [one.landmarks_px is b.landmarks_px for one in a.others] == [True]
    scale = 24 / np.ptp(landmarks_px[:, 1])
    wide = np.full((3000, 4000, 3), 128, np.uint8)
    small = resized(PHOTO, scale)
    wide[1900 : 1900 + len(small), 3100 : 3100 + small.shape[1]] = small
    (face,) = detect_faces(SHIPPED_NETWORKS.people, wide, everyone=True)
    assert error_iod(face.landmarks_px - [3100, 1900], scale * landmarks_px) < 0.15


@pytest.mark.parametrize("shape", [(1, 5000, 3), (200, 300, 3)])
def test_no_face_names_the_image_and_a_way_out(shape):
    with pytest.raises(InputError, match=r"holiday\.png: no face found.*--landmarks"):
        find_faces(SHIPPED_NETWORKS.people, np.random.default_rng(0).random(shape, np.float32), "holiday.png")


def test_a_face_larger_than_the_photo():
    """From the eyes to the mouth."""
    (whole,) = detect_faces(SHIPPED_NETWORKS.people, PHOTO)
    face = whole.landmarks_px
    x0, x1 = (int(face[corner, 0]) for corner in (37, 44))
    y0, y1 = int(face[37, 1]) - 4, int(face[57, 1])
    (near,) = detect_faces(
        SHIPPED_NETWORKS.people, np.kron(PHOTO[y0:y1, x0:x1], np.ones((3, 3, 1), np.uint8))
    )
    off = np.linalg.norm(near.landmarks_px / 3 + [x0, y0] - face, axis=1)
    assert off[INNER].mean() < 0.12 * iod_px(face)


def test_eyes_of_a_face_that_fills_the_photo_are_no_faces(shared_data):
    (path,) = (shared_data / "extended_yale_b/yaleB06").glob("*A+000E+00.pgm")
    grey = np.asarray(Image.open(path), np.float32) / 255
    (face,) = find_faces(SHIPPED_NETWORKS.people, np.repeat(grey[..., None], 3, -1), "yaleB06")
    assert np.ptp(face.landmarks_px, axis=0).min() > 0.9 * grey.shape[1]


@pytest.mark.parametrize("turn", [40, 250])
def test_heads_in_any_turn_are_found_among_others(landmarks_px, turn):
    lying = skimage.transform.rotate(PHOTO, turn, resize=True)
    lying = resized(np.round(255 * lying).astype(np.uint8), 0.7)
    height = max(len(lying), len(PHOTO))
    pair = [np.pad(image, ((0, height - len(image)), (0, 0), (0, 0))) for image in (PHOTO, lying)]
    assert len(detect_faces(SHIPPED_NETWORKS.people, np.concatenate(pair, 1), everyone=True)) == 2
