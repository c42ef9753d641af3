"""Descriptors distinguish people and do not depend on the face's position in the image."""

from pathlib import Path

import numpy as np
import pytest
import skimage.data

from facerf_cli.errors import FacerfError
from facerf_cli.face import descriptor as module
from facerf_cli.face.descriptor import face_descriptor
from facerf_cli.files.read import read_image
from facerf_cli.image.colour import to_display
from facerf_cli.portrait.find import find_faces
from facerf_cli.relighting.models import SHIPPED_NETWORKS
from tests.kinds import Patch
from tests.refusals import refused

PHOTO = skimage.data.astronaut()[:330, 80:370] / 255.0  # not square


@pytest.fixture(scope="module")
def landmarks_px() -> np.ndarray:
    return find_faces(SHIPPED_NETWORKS.people, (PHOTO**2.2).astype(np.float32), "astronaut")[0].landmarks_px


@pytest.fixture(scope="module")
def descriptor(landmarks_px: np.ndarray) -> np.ndarray:
    return face_descriptor(PHOTO, landmarks_px)


def test_a_face_is_its_own_whatever_its_exposure(descriptor: np.ndarray, landmarks_px: np.ndarray) -> None:
    moved = np.pad(PHOTO, ((30, 5), (12, 40), (0, 0)))
    assert descriptor.shape == (128,)
    assert np.linalg.norm(face_descriptor(moved, np.add(landmarks_px, (12, 30))) - descriptor) < 0.02
    darker = PHOTO * 0.8 + 0.01 * np.random.default_rng(0).normal(size=PHOTO.shape)
    elsewhere = face_descriptor(PHOTO, np.add(landmarks_px, (60, 90)))
    assert np.linalg.norm(face_descriptor(darker, landmarks_px) - descriptor) < 0.2
    assert np.linalg.norm(elsewhere - descriptor) > 0.5


def test_people_are_told_apart(shared_data: Path, descriptor: np.ndarray) -> None:
    """Two photos of one person, taken years apart, and one of another."""
    found = []
    for name in ("obama.jpg", "obama2.jpg"):
        pixels = read_image(shared_data / "photos" / name).pixels
        face = find_faces(SHIPPED_NETWORKS.people, pixels, name)[0]
        found.append(face_descriptor(to_display(pixels) / 255.0, face.landmarks_px))
    assert (
        np.linalg.norm(found[0] - found[1]) < 0.6 < min(np.linalg.norm(each - descriptor) for each in found)
    )


def test_other_shapes_and_a_missing_model_are_refused(landmarks_px: np.ndarray, monkeypatch: Patch) -> None:
    refused(ValueError, "(330, 290)", face_descriptor, PHOTO[..., 0], landmarks_px)
    refused(ValueError, "(67, 2)", face_descriptor, PHOTO, landmarks_px[:67])
    monkeypatch.setattr(module, "find_spec", lambda name: None)
    module._recognition.cache_clear()
    refused(FacerfError, "pip install 'facerf[dlib]'", face_descriptor, PHOTO, landmarks_px)
