"""Faces are chosen among several; landmark files are read; displays are exposed by themselves."""

import json

import numpy as np
import pytest

from facerf_cli.errors import InputError, UsageError
from facerf_cli.face.landmarks import read_landmarks
from facerf_cli.image.colour import to_display
from facerf_cli.portrait import find
from facerf_cli.portrait.find import Face, choose_face
from tests.refusals import refused


@pytest.fixture
def landmarks_px():
    return np.random.default_rng(0).uniform(20, 80, (68, 2))


def test_faces_by_size_sureness_and_number(landmarks_px, caplog, monkeypatch):
    doubtful, sure = (Face((0, 0, side, side), score, landmarks_px) for side, score in ((50, 0.4), (49, 1.2)))
    assert choose_face([doubtful, sure], "largest", "p") == [sure]
    monkeypatch.setattr(find.log, "propagate", True)
    caplog.set_level("INFO")
    small, large = (Face((0, 0, side, side), 1.0, landmarks_px) for side in (20, 50))
    faces = [small, large]
    assert choose_face(faces, "largest", "p") == [large] and choose_face(faces, "all", "p") == faces
    assert "p: using the largest of 2 faces" in caplog.text
    assert choose_face(faces, "0", "p") == [small]
    refused(InputError, "2 face", choose_face, faces, "2", "p")
    for which in ("-1", "biggest", ""):
        refused(UsageError, "largest", choose_face, faces, which, "p")
    linear = np.random.default_rng(0).random((300, 70, 3), np.float32)
    assert to_display(linear).dtype == np.uint8
    assert np.abs(to_display(linear).astype(int) - to_display(linear * 1000)).max() <= 1
    assert to_display(np.zeros((4, 5, 3), np.float32)).max() == 0


def write_pts(path, points):
    rows = "\n".join(f"{x} {y}" for x, y in points)
    path.write_text(f"version: 1\nn_points: {len(points)}\n{{\n{rows}\n}}\n")
    return path


def test_files_of_landmarks_are_read_or_named(tmp_path, landmarks_px):
    pts = write_pts(tmp_path / "a.pts", landmarks_px + 0.5)  # iBUG counts the first pixel's centre as 1
    assert read_landmarks(pts) == pytest.approx(landmarks_px)
    for content in (landmarks_px.tolist(), {"landmarks": landmarks_px.tolist()}):
        (tmp_path / "a.json").write_text(json.dumps(content))
        assert read_landmarks(tmp_path / "a.json") == pytest.approx(landmarks_px)
    (tmp_path / "b.json").write_bytes(bytes(range(256)))
    for name in ("b.json", "missing.pts"):
        refused(InputError, name, read_landmarks, tmp_path / name)


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
    refused(InputError, name, read_landmarks, tmp_path / name)
