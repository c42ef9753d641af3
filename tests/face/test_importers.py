"""ICT-FaceKit at the door: the carried mean against the original, and archives that are not what they say."""

import io
import tarfile
import zipfile
from pathlib import Path

import numpy as np
import pytest
import trimesh
from scipy.spatial import cKDTree

from facerf_cli.errors import InputError
from facerf_cli.face import importers
from facerf_cli.face.importers import SourceModel, carry_over, import_ict_facekit, rigid_alignment
from facerf_cli.face.morphable import MorphableModel, load_face_model, save_face_model
from facerf_cli.face.topology import GRID, LANDMARKS_M, grid_triangles, landmark_weights

NEUTRAL = "ICT-FaceKit-master/FaceXModel/generic_neutral_mesh.obj"


@pytest.fixture(scope="module")
def ict(shared_data: Path) -> tuple[SourceModel, MorphableModel]:
    """The original with three of its shapes, and what became of it."""
    wanted = ("generic_neutral_mesh", "identity000", "identity001", "jawOpen")
    archive = shared_data / "ict_facekit" / "ICT-FaceKit-master.tar.xz"
    raw = {}
    with tarfile.open(archive, "r|*") as tar:
        for member in tar:
            if Path(member.name).stem in wanted and "FaceXModel/" in member.name:
                raw[Path(member.name).stem] = tar.extractfile(member).read()
    source = importers._ict_source(archive, raw)
    return source, carry_over(source)


def aligned(source: SourceModel, field: np.ndarray) -> np.ndarray:
    rotation, translation = rigid_alignment(source.mean[source.landmarks], LANDMARKS_M)
    return field @ rotation.T + translation


def distance_mm(points: np.ndarray, mesh: trimesh.Trimesh) -> np.ndarray:
    """Distance of points [N, 3] to a mesh, over the 40 nearest triangles: never too small."""
    _, nearby = cKDTree(mesh.triangles_center).query(points, 40)
    closest = [trimesh.triangles.closest_point(mesh.triangles[faces], points) for faces in nearby.T]
    return 1000 * np.linalg.norm(np.array(closest) - points, axis=-1).min(0)


def test_the_mean_lies_on_the_original_surface(ict):
    source, model = ict
    corners = model.mean.numpy()[grid_triangles().numpy()]  # [F, 3, 3]
    samples = np.concatenate([corners.mean(1), corners[:, :2].mean(1)])
    original = trimesh.Trimesh(aligned(source, source.mean), source.triangles, process=False)
    off_mm = distance_mm(samples, original)
    assert np.sqrt((off_mm**2).mean()) < 0.1  # asked for: 0.3
    assert np.percentile(off_mm, 99) < 0.3


def test_landmarks_stay_where_they_were(ict):
    source, model = ict
    found = model.landmarks(model.mean[None])[0].numpy()
    off_mm = 1000 * np.linalg.norm(found - aligned(source, source.mean)[source.landmarks], axis=-1)
    assert off_mm.max() < 0.6  # asked for: 1.5; the inner corners of the mouth hide from the rays
    assert off_mm.mean() < 0.15


def test_shapes_move_the_landmarks_as_they_did(ict):
    source, model = ict
    corners, weights = landmark_weights()
    rotation, _ = rigid_alignment(source.mean[source.landmarks], LANDMARKS_M)
    for ours, theirs in ((model.identity, source.identity), (model.expression, source.expression)):
        carried = (ours[:, corners] * weights[..., None]).sum(2).numpy()
        original = theirs[:, source.landmarks] @ rotation.T
        assert np.abs(carried - original).max() < 0.1 * np.abs(original).max()
    assert model.expression_names == ("jawOpen",) and "USC" in model.licence


def test_a_carried_model_survives_its_file(ict, tmp_path):
    save_face_model(tmp_path / "ict.npz", ict[1])
    again = load_face_model(tmp_path / "ict.npz")
    assert again.name == "ict-facekit" and again.mean.shape == (GRID * GRID, 3)
    assert (again.identity - ict[1].identity).abs().max() < 2e-5


def zipped(path: Path, **members: bytes) -> Path:
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for stem, data in members.items():
            archive.writestr(NEUTRAL.replace("generic_neutral_mesh", stem), data)
    return path


def obj(vertices: int = importers._ICT_VERTICES, face: bytes = b"f 1/1 2/2 3/3\n") -> bytes:
    return b"v 0.5 1 2\n" * vertices + face


def damaged(path: Path, at: float) -> Path:
    """The file with some bytes in its middle overwritten."""
    data = bytearray(path.read_bytes())
    start = int(at * len(data))
    data[start : start + 64] = b"\xff" * 64
    path.write_bytes(data)
    return path


def tarred(path: Path, mode: str, data: bytes) -> Path:
    with tarfile.open(path, mode) as tar:
        entry = tarfile.TarInfo(NEUTRAL)
        entry.size = len(data)
        tar.addfile(entry, io.BytesIO(data))
    return path


def noise(length: int) -> bytes:
    return np.random.default_rng(0).bytes(length)


def cut(path: Path) -> Path:
    path.write_bytes(path.read_bytes()[:50_000])
    return path


HOSTILE = {
    "not there": (lambda t: t / "none.zip", "folder, or its .zip"),
    "a picture": (lambda t: (t / "a.png").write_bytes(b"\x89PNG") and t / "a.png", "folder, or its .zip"),
    "an empty folder": (lambda t: t, "no FaceXModel"),
    "an empty zip": (lambda t: zipped(t / "a.zip"), "no FaceXModel"),
    "no neutral mesh": (lambda t: zipped(t / "a.zip", jawOpen=obj()), "no FaceXModel"),
    "no shapes": (lambda t: zipped(t / "a.zip", generic_neutral_mesh=obj()), "are missing"),
    "a short mesh": (
        lambda t: zipped(t / "a.zip", generic_neutral_mesh=obj(10), identity000=obj()),
        "10 vertices",
    ),
    "words for numbers": (
        lambda t: zipped(t / "a.zip", generic_neutral_mesh=b"v one two three\n"),
        "damaged",
    ),
    "faces beyond the vertices": (
        lambda t: zipped(
            t / "a.zip", generic_neutral_mesh=obj(face=b"f 1 2 99999\n"), identity000=obj(), jawOpen=obj()
        ),
        "faces are damaged",
    ),
    "a face of words": (
        lambda t: zipped(
            t / "a.zip", generic_neutral_mesh=obj(face=b"f a b c\n"), identity000=obj(), jawOpen=obj()
        ),
        "faces are damaged",
    ),
    "not finite": (
        lambda t: zipped(t / "a.zip", generic_neutral_mesh=obj(importers._ICT_VERTICES - 1) + b"v nan 0 0\n"),
        "vertices|damaged",
    ),
    "a surface that is one point": (
        lambda t: zipped(t / "a.zip", generic_neutral_mesh=obj(), identity000=obj(), jawOpen=obj()),
        "does not cover the chart",
    ),
    "a bomb": (lambda t: zipped(t / "a.zip", generic_neutral_mesh=bytes(65 << 20)), "too large"),
    "a damaged zip": (
        lambda t: damaged(zipped(t / "a.zip", generic_neutral_mesh=noise(200_000)), 0.5),
        "cannot be read",
    ),
    "a damaged xz": (
        lambda t: damaged(tarred(t / "a.tar.xz", "w:xz", noise(200_000)), 0.5),
        "cannot be read",
    ),
    "a cut xz": (lambda t: cut(tarred(t / "a.tar.xz", "w:xz", noise(200_000))), "cannot be read"),
    "a cut gz": (lambda t: cut(tarred(t / "a.tar.gz", "w:gz", noise(200_000))), "cannot be read"),
    "a cut tar": (lambda t: cut(tarred(t / "a.tar", "w", noise(200_000))), "cannot be read"),
}


@pytest.mark.parametrize("case", HOSTILE)
def test_what_is_not_ict_facekit_is_refused_in_one_line(case: str, tmp_path: Path):
    make, message = HOSTILE[case]
    with pytest.raises(InputError, match=message) as refused:
        import_ict_facekit(make(tmp_path))
    assert str(tmp_path) in str(refused.value) and "\n" not in str(refused.value)
