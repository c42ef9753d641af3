"""A head in a face model's file: what goes in comes out, and what is not a head is refused in one line."""

import zipfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from facerf_cli.errors import InputError
from facerf_cli.face.morphable import HeadModel, MorphableModel, load_face_model, save_face_model
from tests.refusals import refused


@pytest.fixture(scope="module")
def model() -> MorphableModel:
    """The built-in model with two of its shapes, and a tetrahedron for a head."""
    builtin = load_face_model()
    head = HeadModel(
        mean=torch.tensor([[0.0, 0, 0], [0.1, 0, 0], [0, 0.1, 0], [0, 0, 0.1]]),
        identity=torch.full((1, 4, 3), 0.25),
        expression=torch.full((1, 4, 3), 0.5),
        triangles=torch.tensor([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]]),
        part=torch.tensor([0, 0, 0, 3], dtype=torch.uint8),
        uv=torch.rand(4, 2),
    )
    return replace(
        builtin,
        identity=builtin.identity[:1],
        expression=builtin.expression[:1],
        expression_names=builtin.expression_names[:1],
        head=head,
    )


def arrays_of(model: MorphableModel, folder: Path) -> dict[str, np.ndarray]:
    save_face_model(folder / "whole.npz", model)
    with np.load(folder / "whole.npz") as file:
        return {key: file[key] for key in file.files}


def test_a_head_survives_its_file_and_coefficients_move_it(model, tmp_path):
    save_face_model(tmp_path / "a.npz", model)
    again = load_face_model(tmp_path / "a.npz").head
    for key in ("mean", "identity", "expression", "triangles", "part", "uv"):
        assert torch.equal(getattr(again, key), getattr(model.head, key))
        assert getattr(again, key).dtype == getattr(model.head, key).dtype
    save_face_model(tmp_path / "a.npz", replace(model, head=None))
    assert load_face_model(tmp_path / "a.npz").head is None and load_face_model().head is None
    moved = model.head.vertices(torch.tensor([2.0]), torch.tensor([-0.5])) - model.head.mean
    assert torch.allclose(moved, torch.full((4, 3), 0.25))


CHANGES = {
    "no uv": lambda a: a.pop("head_uv"),
    "a vertex too few": lambda a: a.update(head_identity=a["head_identity"][:, 1:]),
    "a shape too many": lambda a: a.update(head_expression=np.zeros((2, 4, 3), np.float16)),
    "not finite": lambda a: a.update(head_mean=np.full((4, 3), np.nan, np.float32)),
    "infinite shapes": lambda a: a.update(head_identity=np.full((1, 4, 3), np.inf, np.float16)),
    "a triangle beyond": lambda a: a.update(head_triangles=np.array([[0, 1, 4]], np.int32)),
    "a triangle before": lambda a: a.update(head_triangles=np.array([[0, 1, -1]], np.int32)),
    "triangles of fractions": lambda a: a.update(head_triangles=np.array([[0.0, 1, 2]])),
    "no triangles": lambda a: a.update(head_triangles=np.zeros((0, 3), np.int32)),
    "an unknown part": lambda a: a.update(head_part=np.array([0, 0, 0, 4], np.uint8)),
    "a number for a mean": lambda a: a.update(head_mean=np.float32(1)),
    "words": lambda a: a.update(head_mean=np.full((4, 3), "x")),
    "too many vertices": lambda a: a.update(head_mean=np.zeros((60_001, 3), np.float32)),
    "an endless layout version": lambda a: a.update(layout_version=np.inf),
    "two layout versions": lambda a: a.update(layout_version=np.array([1, 1])),
    "too large": lambda a: a.update(head_uv=np.zeros((1 << 19, 2, 50), np.float32)),
}


@pytest.mark.parametrize("case", CHANGES)
def test_what_is_no_head_is_refused_in_one_line(case: str, model, tmp_path):
    arrays = arrays_of(model, tmp_path)
    CHANGES[case](arrays)
    np.savez_compressed(tmp_path / "bad.npz", **arrays)
    refused(InputError, "bad.npz ... not a facerf face model", load_face_model, tmp_path / "bad.npz")


def test_an_array_that_claims_more_than_memory_holds_is_refused(model, tmp_path):
    arrays = arrays_of(model, tmp_path)
    np.savez(tmp_path / "whole.npz", **{key: array for key, array in arrays.items() if key != "mean"})
    header = b"{'descr': '<f4', 'fortran_order': False, 'shape': (1000000000000, 3), }"
    header += b" " * (117 - len(header)) + b"\n"
    with zipfile.ZipFile(tmp_path / "whole.npz", "a") as archive:
        archive.writestr("mean.npy", b"\x93NUMPY\x01\x00" + len(header).to_bytes(2, "little") + header)
    refused(InputError, "not a facerf face model", load_face_model, tmp_path / "whole.npz")


@pytest.mark.parametrize("at", [0.2, 0.5, 0.8])
def test_a_damaged_file_is_refused_in_one_line(at: float, model, tmp_path):
    save_face_model(tmp_path / "a.npz", model)
    data = bytearray((tmp_path / "a.npz").read_bytes())
    start = int(at * len(data))
    data[start : start + 64] = b"\xff" * 64
    (tmp_path / "a.npz").write_bytes(data)
    refused(InputError, "not a facerf face model", load_face_model, tmp_path / "a.npz")
