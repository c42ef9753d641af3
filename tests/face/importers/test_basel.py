"""The Basel models' files, with the structure they are published with, made from the built-in face."""

import json
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scipy.io

from facerf_cli.errors import FacerfError, InputError
from facerf_cli.face.importers import basel
from facerf_cli.face.importers.basel import read_basel
from facerf_cli.face.importers.resample import import_face_model, resample_model, rigid_alignment
from facerf_cli.face.importers.source import SourceModel
from facerf_cli.face.morphable import load_face_model
from facerf_cli.face.topology import LANDMARKS_M
from tests.face.importers.heads import Head, arrays_here, head, off_mm
from tests.kinds import Patch
from tests.refusals import refused

h5py = pytest.importorskip("h5py")

SHAPES, EXPRESSIONS = 199, 100
NAMES = {number: name for name, number in basel._LANDMARKS_2017.items()}


@pytest.fixture(scope="module")
def face() -> Head:
    return head(60, 60, turn_deg=4)


@pytest.fixture
def here(monkeypatch: Patch) -> None:
    """Read in this process: starting another takes a second."""
    monkeypatch.setattr(basel, "read_in_subprocess", arrays_here)


def orthonormal(shapes: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """A basis [3 N, count] of unit length and deviations [count] that say the same as shapes [K, N, 3]."""
    basis = np.zeros((shapes[0].size, count), np.float32)
    deviations = np.zeros((count, 1), np.float32)
    for index, shape in enumerate(shapes):
        deviations[index] = np.linalg.norm(shape)
        basis[:, index] = shape.ravel() / deviations[index]
    basis[0, len(shapes) :] = 1
    return basis, deviations


def mat(face: Head) -> dict[str, Any]:
    """`01_MorphableModel.mat`: micrometres, deviations, triangles from 1 on and the wrong way round."""
    basis, deviations = orthonormal(face.shapes * 1e6, SHAPES)
    column = (face.mean * 1e6).reshape(-1, 1).astype(np.float32)
    return {
        "shapeMU": column,
        "shapePC": basis,
        "shapeEV": deviations,
        "texMU": column * 0,
        "texPC": basis * 0,
        "texEV": deviations * 0,
        "tl": (face.triangles[:, [0, 2, 1]] + 1).astype(np.float64),
        "segbin": np.zeros((len(face.mean), 4), np.uint8),
        "segMM": np.zeros((3, 3)),
        "segMB": np.zeros((3, 3)),
    }


def written_mat(path: Path, arrays: dict[str, Any]) -> Path:
    scipy.io.savemat(path, arrays, do_compression=True)
    return path


@pytest.fixture(scope="module")
def shift(face: Head) -> np.ndarray:
    """The mean of the expressions: a displacement of the mouth from the neutral face."""
    around = np.exp(-((np.linalg.norm(face.mean - face.landmarks[62], axis=-1) / 0.02) ** 2))
    return 0.001 * around[:, None] * [0.0, -1, 0]


def h5(path: Path, face: Head, shift: np.ndarray, **changes: Any) -> Path:
    """`model2017-1_*.h5`: statismo's groups, millimetres, and scalismo's landmarks."""
    basis, deviations = orthonormal(face.shapes * 1000, SHAPES)
    moved, spread = orthonormal(face.shapes[:1] * 500, EXPRESSIONS)
    marks = [
        {"coordinates": (1000 * face.mean[_nearest(face, number)]).tolist(), "id": name}
        for number, name in NAMES.items()
    ]
    inside = [{"coordinates": (1000 * face.mean.mean(0)).tolist(), "id": "center.nose.tip"}]
    tables: dict[str, Any] = {
        "shape/model/mean": (1000 * face.mean).ravel().astype("f4"),
        "shape/model/pcaBasis": basis,
        "shape/model/pcaVariance": (deviations**2).ravel(),
        "shape/model/noiseVariance": np.zeros(1, "f4"),
        "shape/representer/cells": face.triangles.T.astype("i4"),
        "shape/representer/points": (1000 * face.mean).T.astype("f4"),
        "expression/model/mean": (1000 * shift).ravel().astype("f4"),
        "expression/model/pcaBasis": moved,
        "expression/model/pcaVariance": (spread**2).ravel(),
        "color/model/mean": np.zeros(face.mean.size, "f4"),
        "metadata/landmarks/json": json.dumps(
            [*marks, {"coordinates": [0, 0, 0], "id": "left.ear"}, *inside]
        ),
        **changes,
    }
    with h5py.File(path, "w") as file:
        for name, values in tables.items():
            if isinstance(values, (h5py.SoftLink, h5py.ExternalLink)):
                file[name] = values
            elif values is not None:
                file.create_dataset(name, data=values)
    return path


def _nearest(face: Head, number: int) -> int:
    return int(np.linalg.norm(face.mean - face.landmarks[number], axis=-1).argmin())


def test_basel_2009_is_read_and_becomes_a_model_with_the_built_in_expressions(
    face: Head, tmp_path: Path
) -> None:
    source = read_basel(written_mat(tmp_path / "01_MorphableModel.mat", mat(face)))
    np.testing.assert_allclose(source.mean, face.mean, atol=1e-7)
    assert source.identity.shape == (SHAPES, len(face.mean), 3) and len(source.expression) == 0
    np.testing.assert_allclose(source.identity[: len(face.shapes)], face.shapes, atol=1e-8)
    assert source.triangles.min() == 0 and source.triangles.max() == len(face.mean) - 1
    assert source.known == {}  # its vertices are numbered otherwise than the published ones
    path = tmp_path / "01_MorphableModel.mat"
    refused(InputError, f"{path}: it names only 0 of the landmarks", import_face_model, path)
    known = {number: face.landmarks[number] for number in basel._LANDMARKS_2009}
    model = resample_model(replace(source, identity=source.identity[:5], known=known))
    builtin = load_face_model()
    assert np.sqrt((off_mm(model, face) ** 2).mean()) < 0.5
    assert model.expression_names == builtin.expression_names
    assert "Basel" in model.licence and builtin.licence in model.licence


def test_a_file_that_crashes_its_reader_is_refused_in_one_line(face: Head, tmp_path: Path) -> None:
    """One changed byte of a .mat is a segmentation fault in scipy 1.17."""
    path = tmp_path / "01_MorphableModel.mat"
    scipy.io.savemat(path, mat(face), do_compression=False)
    content = bytearray(path.read_bytes())
    content[43449] = 90
    path.write_bytes(content)
    refused(InputError, "not a Basel Face Model 2009", read_basel, path)


def test_the_published_mesh_of_2009_has_its_landmarks(monkeypatch: Patch, tmp_path: Path) -> None:
    mean_mm, cells = 1e3 * np.arange(53490 * 3, dtype=np.float64), np.array([[0], [1], [2]])
    model = mean_mm, np.eye(len(mean_mm), 1), np.ones(1)
    arrays = {f"shape/model/{name}": array for name, array in zip(basel._MODEL, model, strict=True)}
    monkeypatch.setattr(basel, "read_in_subprocess", lambda *_: {**arrays, "shape/representer/cells": cells})
    (tmp_path / "a.mat").touch()
    known = read_basel(tmp_path / "a.mat").known
    assert len(known) == 18 and set(known) <= set(range(17, 68))
    assert known[30][0] == 3 * 8319 and known[54][0] == 3 * 11714


@pytest.mark.usefixtures("here")
@pytest.mark.parametrize("file", ["model2017-1_bfm_nomouth.h5", "model2019_bfm.h5"])
def test_basel_2017_is_read_in_metres_and_deviations(
    face: Head, shift: np.ndarray, tmp_path: Path, file: str
) -> None:
    source = read_basel(h5(tmp_path / file, face, shift))
    assert source.name == f"basel-{file[5:9]}" and f"Model {file[5:9]}" in source.licence
    np.testing.assert_allclose(source.mean, face.mean, atol=1e-7)
    np.testing.assert_array_equal(source.triangles, face.triangles)
    np.testing.assert_allclose(source.identity[: len(face.shapes)], face.shapes, atol=1e-8)
    np.testing.assert_allclose(source.expression[0], shift, atol=1e-8)  # zeros are the neutral face
    np.testing.assert_allclose(source.expression[1], face.shapes[0] / 2, atol=1e-8)
    assert len(source.expression) == len(source.expression_names) == EXPRESSIONS + 1
    assert source.expression_names[:2] == ("mean_expression", "expression_000")
    assert set(source.known) == set(NAMES)
    for number, point in source.known.items():
        np.testing.assert_allclose(point, face.mean[_nearest(face, number)], atol=1e-7)


@pytest.mark.usefixtures("here")
def test_a_surface_that_ends_early_goes_on_as_the_built_in_face(tmp_path: Path) -> None:
    whole = head(120, 120, turn_deg=4)  # fine, because a named landmark lies on a vertex
    source = read_basel(h5(tmp_path / "face12.h5", whole, whole.mean * 0))
    away = (whole.mean - whole.landmarks[30]) @ rigid_alignment(LANDMARKS_M, whole.landmarks)[0]

    def oval(width_m: float, height_m: float) -> SourceModel:
        inside = (away[:, 0] / width_m) ** 2 + ((away[:, 1] + 0.005) / height_m) ** 2 < 1
        return replace(source, triangles=whole.triangles[inside[whole.triangles].all(1)])

    part = oval(0.074, 0.108)  # without the grid's corners and the contour's ends
    model = resample_model(part)
    off = off_mm(model, whole)
    assert np.median(off) < 0.5 and off.max() < 12
    assert len(model.identity) == SHAPES and len(model.expression) == EXPRESSIONS + 1
    moved = model.identity[0].norm(dim=-1)
    corners = moved.reshape(129, 129)[[0, 0, -1, -1], [0, -1, 0, -1]]
    assert 0.5 * moved.mean() < corners.mean() < 2 * moved.mean()
    with pytest.raises(InputError, match=r"covers \d+ % of the face"):
        resample_model(oval(0.060, 0.085))


@pytest.mark.usefixtures("here")
def test_the_names_may_be_bytes_or_missing(face: Head, shift: np.ndarray, tmp_path: Path) -> None:
    text = json.dumps([{"coordinates": (1000 * face.mean[7]).tolist(), "id": "center.nose.tip"}])
    encoded = text.encode()  # scalismo writes an array of one text of fixed length
    for written in (np.bytes_(encoded), np.array([encoded]), [text], np.frombuffer(encoded, np.uint8)):
        path = h5(tmp_path / "model.h5", face, shift, **{"metadata/landmarks/json": written})
        assert set(read_basel(path).known) == {30}
    path = h5(tmp_path / "model.h5", face, shift, **{"metadata/landmarks/json": None})
    assert read_basel(path).known == {}


def test_h5py_is_an_extra(tmp_path: Path, monkeypatch: Patch) -> None:
    monkeypatch.setitem(sys.modules, "h5py", None)
    (tmp_path / "model.h5").touch()
    refused(FacerfError, "pip install 'facerf[face-models]'", read_basel, tmp_path / "model.h5")


@pytest.mark.usefixtures("here")
def test_what_is_not_basel_2009_is_refused_in_one_line(face: Head, tmp_path: Path) -> None:
    for change in ({"shapePC": np.zeros((9, 199))}, {"shapeEV": {"a": 1}}):
        path = written_mat(tmp_path / "a.mat", mat(face) | change)
        refused(InputError, f"{path} ... not a Basel Face Model 2009", import_face_model, path)


WRONG_H5: dict[str, tuple[dict[str, Any], str]] = {
    "no expressions": ({"expression/model/mean": None}, "it lacks expression/model"),
    "scaled already": ({"shape/model/pcaBasis": 7 * np.ones((10800, 199), "f4")}, "unit length"),
    "variance below zero": ({"shape/model/pcaVariance": -np.ones(199)}, "pcaVariance is negative"),
    "a link to another file": ({"shape/model/mean": h5py.ExternalLink("b.h5", "/a")}, "2017"),
    "names of another kind": ({"metadata/landmarks/json": "[1, 2]"}, "not a Basel Face Model 2017"),
}


@pytest.mark.usefixtures("here")
@pytest.mark.parametrize("case", WRONG_H5)
def test_what_is_not_basel_2017_is_refused_in_one_line(
    face: Head, shift: np.ndarray, tmp_path: Path, case: str
) -> None:
    changes, message = WRONG_H5[case]
    path = h5(tmp_path / "a.h5", face, shift, **changes)
    refused(InputError, f"{path} ... {message}", import_face_model, path)


def test_a_huge_claim_takes_no_room(tmp_path: Path, face: Head, shift: np.ndarray) -> None:
    path = h5(tmp_path / "a.h5", face, shift, **{"shape/model/pcaBasis": None})
    with h5py.File(path, "a") as file:
        file.create_dataset("shape/model/pcaBasis", (10**9, 199), "f4", chunks=(1000, 199))
    refused(InputError, "allocate", read_basel, path)
    (tmp_path / "b.h5").write_bytes(path.read_bytes()[:5000])
    refused(InputError, "not a Basel Face Model 2017", read_basel, tmp_path / "b.h5")
