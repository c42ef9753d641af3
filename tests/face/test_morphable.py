"""A face model's file: what goes in comes out, and what is not a face model is refused in one line."""

import zipfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from facerf_cli.errors import InputError
from facerf_cli.face import morphable
from facerf_cli.face.morphable import MorphableModel, load_face_model, save_face_model
from tests.refusals import refused


@pytest.fixture(scope="module")
def model() -> MorphableModel:
    """The built-in model with two of its shapes."""
    builtin = load_face_model()
    return replace(
        builtin,
        identity=builtin.identity[:1],
        expression=builtin.expression[:1],
        expression_names=builtin.expression_names[:1],
    )


def arrays_of(model: MorphableModel, folder: Path) -> dict[str, np.ndarray]:
    save_face_model(folder / "whole.npz", model)
    with np.load(folder / "whole.npz") as file:
        return {key: file[key] for key in file.files}


def test_a_model_survives_its_file_and_coefficients_move_it(model, tmp_path):
    save_face_model(tmp_path / "a.npz", model)
    again = load_face_model(tmp_path / "a.npz")
    for key in ("mean", "identity", "expression"):  # the built-in shapes are in half precision
        assert torch.equal(getattr(again, key), getattr(model, key))
    assert (again.name, again.expression_names) == (model.name, model.expression_names)
    moved = model.vertices(torch.tensor([[2.0]]), torch.tensor([[-0.5]]))[0] - model.mean
    torch.testing.assert_close(moved, 2 * model.identity[0] - 0.5 * model.expression[0], atol=1e-7, rtol=0)


CHANGES = {
    "no expressions": lambda a: a.pop("expression"),
    "a vertex too few": lambda a: a.update(identity=a["identity"][:, 1:]),
    "a basis of one shape alone": lambda a: a.update(identity=a["identity"][0]),
    "too many shapes": lambda a: a.update(expression=np.zeros((501, *a["mean"].shape), np.float16)),
    "not finite": lambda a: a.update(mean=np.full_like(a["mean"], np.nan)),
    "infinite shapes": lambda a: a.update(identity=np.full_like(a["identity"], np.inf)),
    "a number for a mean": lambda a: a.update(mean=np.float32(1)),
    "words": lambda a: a.update(mean=np.full(a["mean"].shape, "x")),
    "an endless layout version": lambda a: a.update(layout_version=np.inf),
    "two layout versions": lambda a: a.update(layout_version=np.array([1, 1])),
}


@pytest.mark.parametrize("case", CHANGES)
def test_what_is_no_face_model_is_refused_in_one_line(case: str, model, tmp_path):
    arrays = arrays_of(model, tmp_path)
    CHANGES[case](arrays)
    np.savez_compressed(tmp_path / "bad.npz", **arrays)
    refused(
        InputError,
        "bad.npz ... not a facerf face model ... face-model import",
        load_face_model,
        tmp_path / "bad.npz",
    )


def test_more_than_a_model_needs_is_refused(model, tmp_path, monkeypatch):
    arrays = arrays_of(model, tmp_path)
    np.savez(tmp_path / "whole.npz", **{key: array for key, array in arrays.items() if key != "mean"})
    header = b"{'descr': '<f4', 'fortran_order': False, 'shape': (1000000000000, 3), }"
    header += b" " * (117 - len(header)) + b"\n"
    with zipfile.ZipFile(tmp_path / "whole.npz", "a") as archive:
        archive.writestr("mean.npy", b"\x93NUMPY\x01\x00" + len(header).to_bytes(2, "little") + header)
    refused(InputError, "not a facerf face model", load_face_model, tmp_path / "whole.npz")
    arrays_of(model, tmp_path)
    monkeypatch.setattr(morphable, "_MAX_BYTES", 1000)
    refused(InputError, "not a facerf face model", load_face_model, tmp_path / "whole.npz")


@pytest.mark.parametrize("at", [0.2, 0.5, 0.8])
def test_a_damaged_file_is_refused_in_one_line(at: float, model, tmp_path):
    save_face_model(tmp_path / "a.npz", model)
    data = bytearray((tmp_path / "a.npz").read_bytes())
    start = int(at * len(data))
    data[start : start + 64] = b"\xff" * 64
    (tmp_path / "a.npz").write_bytes(data)
    refused(InputError, "not a facerf face model", load_face_model, tmp_path / "a.npz")


def test_a_text_is_not_a_face_model(tmp_path: Path) -> None:
    (tmp_path / "a.npz").write_text("hello")
    refused(InputError, "not a zip file ... face-model import", load_face_model, tmp_path / "a.npz")
