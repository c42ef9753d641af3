"""The built-in model is what its recipe builds, symmetric, and has its landmarks."""

import numpy as np
import pytest
import torch

from facerf_cli.face.morphable import MorphableModel, load_face_model
from facerf_cli.face.topology import GRID, LANDMARKS_M
from tools.builtin_face import build

MIRROR = torch.tensor([-1.0, 1, 1])


@pytest.fixture(scope="module")
def model() -> MorphableModel:
    return load_face_model()


def mirrored(field: torch.Tensor) -> torch.Tensor:
    return (field.reshape(GRID, GRID, 3).flip(1) * MIRROR).reshape(-1, 3)


@pytest.mark.slow
def test_the_asset_is_what_the_recipe_builds(model):
    built = build()
    assert model.expression_names == built.expression_names
    assert torch.equal(model.mean, built.mean) or (model.mean - built.mean).abs().max() < 1e-6
    assert (model.expression - built.expression).abs().max() < 3e-5  # kept in half precision
    spread, rebuilt = (m.identity.square().sum(0).sqrt() for m in (model, built))  # modes may turn
    assert (spread - rebuilt).abs().max() < 3e-5


def test_the_mean_is_read_once_symmetric_and_its_left_is_the_subjects(model):
    assert load_face_model() is load_face_model("builtin")
    assert torch.equal(model.mean, mirrored(model.mean))
    found = model.landmarks(model.mean[None])[0].numpy()
    assert np.linalg.norm(found - LANDMARKS_M, axis=-1).max() < 0.5e-3
    smile = model.expression[model.expression_names.index("smile_left")]
    assert smile[model.mean[:, 0] > 0.01].norm() > 5 * smile[model.mean[:, 0] < -0.01].norm()
