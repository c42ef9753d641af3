import pytest

from facerf_cli.face.morphable import MorphableModel, load_face_model
from facerf_cli.synth.bank.heads import mean_coefficients
from facerf_cli.synth.head.heads import build_head
from facerf_cli.synth.head.mesh import HeadMesh


@pytest.fixture(scope="session")
def model() -> MorphableModel:
    return load_face_model()


@pytest.fixture(scope="session")
def head(model: MorphableModel) -> HeadMesh:
    return build_head(model, *mean_coefficients(model))
