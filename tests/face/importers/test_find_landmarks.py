"""Landmarks found by the shape of a face, against those that ICT-FaceKit's authors name."""

import numpy as np
import pytest

from facerf_cli.errors import InputError
from facerf_cli.face.importers.basel import _LANDMARKS_2017 as _LANDMARKS
from facerf_cli.face.importers.find_landmarks import _correction, find_landmarks
from facerf_cli.face.importers.ict import LANDMARK_IDS
from facerf_cli.face.importers.source import SourceModel
from facerf_cli.face.topology import LANDMARKS_M, MIRROR_68
from tests.face.importers.heads import head
from tests.refusals import refused


@pytest.fixture(scope="module")
def someone(ict_source: SourceModel) -> np.ndarray:
    """A person that the built-in model has not seen [N, 3]."""
    return ict_source.mean + 1.5 * ict_source.identity[0] - 1.5 * ict_source.identity[1]


@pytest.mark.parametrize(
    ("named", "mean_mm", "most_mm"), [((), 1.5, 4.0), (tuple(_LANDMARKS.values()), 1.2, 3.0)]
)
def test_they_lie_where_the_authors_see_them(
    ict_source: SourceModel, someone: np.ndarray, named: tuple[int, ...], mean_mm: float, most_mm: float
) -> None:
    truth = someone[LANDMARK_IDS]
    found = find_landmarks(someone, ict_source.triangles, {number: truth[number] for number in named})
    off_mm = 1000 * np.linalg.norm(found - truth, axis=-1)
    others = [number for number in range(68) if number not in named]
    print(f"{off_mm[others].mean():.2f} mm on average, {off_mm[others].max():.2f} at most")
    assert off_mm[others].mean() < mean_mm and off_mm[others].max() < most_mm
    assert not off_mm[list(named)].any()


def test_what_the_known_ones_are_missed_by_moves_their_neighbours_too() -> None:
    points, shift = LANDMARKS_M, np.array([0.002, -0.001, 0.001])
    everywhere = _correction(points, {number: points[number] + shift for number in (8, 30, 36, 45, 51)})
    np.testing.assert_allclose(everywhere, np.broadcast_to(shift, (68, 3)), atol=1e-9)
    lips = {number: points[number] + shift * (number == 51) for number in (8, 30, 36, 45, 51)}
    moved = np.linalg.norm(_correction(points, lips), axis=-1) / np.linalg.norm(shift)
    assert moved[51] == pytest.approx(1) and moved[62] > 0.7 and moved[19] < 0.2


def test_turned_mirrored_and_missing_faces_and_any_winding() -> None:
    face = head(70, 70, turn_deg=50)
    known = {number: face.landmarks[number] for number in (8, 30, 36, 45)}
    off_mm = 1000 * np.linalg.norm(find_landmarks(face.mean, face.triangles, known) - face.landmarks, axis=-1)
    assert off_mm.mean() < 1.0
    face = head(70, 70)
    found = [find_landmarks(face.mean, face.triangles[:, order], {}) for order in ([0, 1, 2], [0, 2, 1])]
    np.testing.assert_array_equal(*found)  # both windings give the same arrays
    flip = np.array([-1.0, 1, 1])
    found, mirrored = (find_landmarks(mean, face.triangles, {}) for mean in (face.mean, face.mean * flip))
    assert np.linalg.norm(mirrored[MIRROR_68] * flip - found, axis=-1).mean() < 0.0007
    x, y = np.meshgrid(np.linspace(-0.1, 0.1, 40), np.linspace(-0.1, 0.1, 40))
    plane = np.stack([x.ravel(), np.zeros(x.size), y.ravel()], -1)
    refused(InputError, "no face is found", find_landmarks, plane, head(40, 40).triangles, {})
