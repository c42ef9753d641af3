"""FLAME's files, with the structure they are published with, made from the built-in face."""

import io
import os
import pickle
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import trimesh
from scipy import sparse

from facerf_cli.errors import InputError
from facerf_cli.face.importers import flame
from facerf_cli.face.importers.flame import read_flame
from facerf_cli.face.importers.resample import import_face_model, nearest_on_mesh, resample_model
from facerf_cli.face.importers.source import SourceModel
from facerf_cli.face.morphable import load_face_model, save_face_model
from tests.face.importers.heads import Head, arrays_here, head, off_mm
from tests.files.pickled import chumpy, python_2, saved_object
from tests.refusals import refused

ROWS, COLUMNS, LOOSE = 71, 70, 53  # 5023 vertices
TRIANGLES = 9976


@pytest.fixture(scope="module")
def face() -> Head:
    return head(ROWS, COLUMNS, LOOSE)


def tables(face: Head, shapes_count: int = 302) -> dict[str, Any]:
    """The arrays of `generic_model.pkl`; its jaw hangs below the lips and turns about an axis in the head."""
    shapes = np.zeros((5023, 3, shapes_count))
    shapes[..., :2] = np.moveaxis(face.shapes, 0, -1)[..., :2]
    if shapes_count > 300:
        shapes[..., 300] = face.shapes[0] / 2
    weights = np.zeros((5023, 5))
    mouth_m = face.landmarks[62:68, 1].mean()
    weights[:, 2] = 1 / (1 + np.exp((face.mean[:, 1] - mouth_m) / 0.002))
    weights[:, 0] = 1 - weights[:, 2]
    regressor = sparse.lil_matrix((5, 5023))
    regressor[:, :] = 0
    regressor[2, 5000] = 1.0  # a loose vertex, in the middle of the head
    triangles = np.concatenate([face.triangles, face.triangles[: TRIANGLES - len(face.triangles)]])
    return {
        "v_template": face.mean,
        "f": triangles.astype(np.uint32),
        "shapedirs": shapes,
        "posedirs": np.zeros((5023, 3, 36)),
        "weights": weights,
        "J_regressor": regressor.tocsc(),
        "J": np.zeros((5, 3)),
        "kintree_table": np.array([[2**32 - 1, 0, 1, 1, 1], [0, 1, 2, 3, 4]]),
        "bs_style": "lbs",
        "bs_type": "lrotmin",
    }


@pytest.fixture(scope="module")
def pkl(face: Head, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A file as Python 2 wrote FLAME 2020's, of chumpy's and scipy's objects."""
    path = tmp_path_factory.mktemp("FLAME2020") / "generic_model.pkl"
    with chumpy() as Ch:
        made = {
            key: Ch(value) if key in ("v_template", "shapedirs") else value
            for key, value in tables(face).items()
        }
        path.write_bytes(python_2(made))
    beside(face, path.parent)
    return path


@pytest.fixture(scope="module")
def source(pkl: Path) -> SourceModel:
    return read_flame(pkl)


@pytest.fixture
def here(source: SourceModel, monkeypatch: pytest.MonkeyPatch) -> None:
    """Read in this process: starting another takes a second."""
    monkeypatch.setattr(flame, "read_in_subprocess", arrays_here)


def embedding(face: Head, first: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Triangles and weights of the head's own landmarks."""
    mesh = trimesh.Trimesh(face.mean, face.triangles, process=False)
    points, faces = nearest_on_mesh(mesh, face.landmarks[first:])
    return faces, trimesh.triangles.points_to_barycentric(mesh.triangles[faces], points)


def deca(face: Head) -> bytes:
    """DECA's `landmark_embedding.npy`: the contour for each turn of the head is in torch's tensors."""
    (faces, weights), (inner, inner_weights) = embedding(face), embedding(face, 17)
    return saved_object(
        {
            "static_lmk_faces_idx": inner,
            "static_lmk_bary_coords": inner_weights,
            "dynamic_lmk_faces_idx": torch.zeros(79, 17, dtype=torch.int64),
            "dynamic_lmk_bary_coords": torch.zeros(79, 17, 3),
            "full_lmk_faces_idx": faces[None],
            "full_lmk_bary_coords": weights[None],
        }
    )


def beside(face: Head, folder: Path) -> Path:
    """DECA's embedding in the folder of a model."""
    path = folder / "landmark_embedding.npy"
    path.write_bytes(deca(face))
    return path


def test_its_arrays_are_read_in_metres_and_deviations(source: SourceModel, face: Head) -> None:
    assert source.name == "flame" and "Max-Planck" in source.licence
    np.testing.assert_allclose(source.mean, face.mean)
    assert source.triangles.shape == (TRIANGLES, 3)
    assert source.identity.shape == (300, 5023, 3) and source.expression.shape == (5, 5023, 3)
    np.testing.assert_allclose(source.identity[:2], face.shapes[:2], atol=1e-8)
    np.testing.assert_allclose(source.expression[0], face.shapes[0] / 2, atol=1e-8)
    assert source.expression_names[0] == "expression_000" and source.expression_names[2] == "jaw_open"


def test_the_jaw_opens_about_its_joint(source: SourceModel, face: Head) -> None:
    opened = source.expression[2]
    chin = np.linalg.norm(face.mean - face.landmarks[8], axis=-1).argmin()
    x, y, z = face.mean[chin] - face.mean[5000]
    turned = [x, y * np.cos(0.1) - z * np.sin(0.1), y * np.sin(0.1) + z * np.cos(0.1)]
    np.testing.assert_allclose(opened[chin], np.array(turned) - [x, y, z], atol=1e-4)
    assert opened[chin, 1] < -0.003 and opened[chin, 2] < -0.003  # down and back
    above = face.mean[:, 1] > face.landmarks[30, 1]
    assert np.abs(opened[above]).max() < 1e-4


def test_a_correction_goes_by_the_entries_of_the_jaw_s_turn(face: Head, tmp_path: Path) -> None:
    made = tables(face, 301)
    made["weights"] = np.eye(5)[np.zeros(5023, int)]
    made["posedirs"][7, 1, 9 + 5] = 2.0  # of the jaw's second row, third column: -sin for a turn about x
    path = tmp_path / "flame.npz"
    np.savez(path, **{key: made[key] for key in ("v_template", "f", "posedirs", "weights")},
             shapedirs=made["shapedirs"], J_regressor=made["J_regressor"].toarray())  # fmt: skip
    opened = read_flame(path, beside(face, tmp_path)).expression[1]
    assert opened[7, 1] == pytest.approx(-2 * np.sin(0.1), rel=1e-5) and np.count_nonzero(opened) == 1


def test_an_import_reproduces_the_mesh(source: SourceModel, face: Head, tmp_path: Path) -> None:
    model = resample_model(replace(source, identity=source.identity[:2]))
    assert np.sqrt((off_mm(model, face) ** 2).mean()) < 0.5
    assert model.identity.shape[0] == 2 and model.expression.shape[0] == 5
    save_face_model(tmp_path / "flame.npz", model)
    again = load_face_model(tmp_path / "flame.npz")
    assert again.name == "flame" and again.expression_names[-3:] == ("jaw_open", "jaw_turn", "jaw_roll")


def bare(face: Head, first: int = 0) -> dict[str, np.ndarray]:
    faces, weights = embedding(face, first)
    return {"lmk_face_idx": faces, "lmk_b_coords": weights}


EMBEDDINGS = {
    "landmark_embedding.npy": lambda face: deca(face),
    "flame_static_embedding.pkl": lambda face: python_2(bare(face)),
    "flame_static_embedding_68.npz": lambda face: npz(bare(face)),
}


def npz(arrays: dict[str, np.ndarray]) -> bytes:
    file = io.BytesIO()
    np.savez(file, **arrays)
    return file.getvalue()


@pytest.mark.usefixtures("here")
@pytest.mark.parametrize("name", EMBEDDINGS)
def test_embeddings_place_the_landmarks(face: Head, tmp_path: Path, name: str) -> None:
    model, path = tmp_path / "generic_model.pkl", tmp_path / name
    model.write_bytes(pickle.dumps(changed(face)))
    path.write_bytes(EMBEDDINGS[name](face))
    found = read_flame(model, None if name == "landmark_embedding.npy" else path).known
    assert sorted(found) == list(range(68))
    off = [1000 * np.linalg.norm(point - face.landmarks[number]) for number, point in found.items()]
    assert max(off) < 1.0 and np.mean(off) < 0.25  # as near as 5023 vertices come


def test_a_table_of_arrays_is_as_good_as_a_pickle(face: Head, source: SourceModel, tmp_path: Path) -> None:
    made = tables(face)
    np.savez(tmp_path / "flame.npz", v_template=made["v_template"], f=made["f"], shapedirs=made["shapedirs"])
    again = read_flame(tmp_path / "flame.npz", beside(face, tmp_path))
    np.testing.assert_array_equal(again.mean, source.mean)
    np.testing.assert_array_equal(again.identity, source.identity)
    assert len(again.expression) == 2  # no skeleton, no jaw


@pytest.mark.usefixtures("here")
def test_a_jaw_is_opened_by_expressions_and_an_open_licence_is_kept(face: Head, tmp_path: Path) -> None:
    beside(face, tmp_path)
    path = tmp_path / "flame2023_no_jaw.pkl"
    path.write_bytes(pickle.dumps(tables(face, 301)))
    assert read_flame(path).expression_names == ("expression_000",)
    said = {"expr_components": "last_100", "n_expr": 100}
    path = tmp_path / "flame2023_Open.pkl"
    path.write_bytes(pickle.dumps(changed(face, supr_expression_metadata=said)))
    assert "CC BY 4.0" in read_flame(path).licence
    path.write_bytes(pickle.dumps(changed(face)))
    assert "CC BY" not in read_flame(path).licence


def changed(face: Head, **changes: Any) -> dict[str, Any]:
    made = tables(face, 2)
    return {key: value for key, value in {**made, **changes}.items() if value is not None}


class Calls:
    """Unpickled by pickle.load, it calls a program."""

    def __reduce__(self) -> Any:
        return os.system, ("true",)


BROKEN: dict[str, tuple[Callable[[Head], Any], str]] = {
    "no mean": (lambda face: changed(face, v_template=None), "it lacks v_template"),
    "shapes of another mesh": (lambda face: changed(face, shapedirs=np.zeros((9, 3, 2))), "shape [9, 3"),
    "too many": (lambda face: changed(face, shapedirs=np.zeros((5023, 3, 801), "f2")), "300 + 50"),
    "not finite": (lambda face: changed(face, v_template=face.mean * np.nan), "non-finite"),
    "triangles beyond": (lambda face: changed(face, f=np.array([[0, 1, 9999]])), "does not have"),
    "a hostile file": (lambda face: changed(face, f=Calls()), "names posix.system, which is not part"),
    "millimetres": (lambda face: changed(face, v_template=face.mean * 1000), "published unit"),
}


@pytest.mark.usefixtures("here")
@pytest.mark.parametrize("case", BROKEN)
def test_what_is_not_flame_is_refused_in_one_line(face: Head, tmp_path: Path, case: str) -> None:
    make, message = BROKEN[case]
    path = tmp_path / "a.pkl"
    path.write_bytes(pickle.dumps(make(face), 2))
    beside(face, tmp_path)
    refused(InputError, f"{path} ... {message}", import_face_model, path)


def test_a_model_without_its_embedding_says_what_to_give(face: Head, tmp_path: Path) -> None:
    np.savez(tmp_path / "flame.npz", **{key: changed(face)[key] for key in ("v_template", "f", "shapedirs")})
    refused(InputError, "--landmarks", read_flame, tmp_path / "flame.npz")
    refused(InputError, "no such file; use FLAME's .pkl", read_flame, tmp_path / "a.pkl")


def points(count: int, face: int, weight: float) -> dict[str, np.ndarray]:
    return {"lmk_face_idx": np.full(count, face), "lmk_b_coords": np.full((count, 3), weight)}


@pytest.mark.usefixtures("here")
@pytest.mark.parametrize(
    "arrays", [points(68, 99999, 1 / 3), points(68, 0, 0)], ids=["of another mesh", "no weights"]
)
def test_an_embedding_of_another_mesh_is_refused(
    face: Head, tmp_path: Path, arrays: dict[str, np.ndarray]
) -> None:
    (tmp_path / "flame.pkl").write_bytes(pickle.dumps(changed(face)))
    path = tmp_path / "e.npz"
    path.write_bytes(npz(arrays))
    refused(InputError, f"{path} ... another mesh", read_flame, tmp_path / "flame.pkl", path)
