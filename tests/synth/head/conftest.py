import pytest

from facerf_cli.face.morphable import MorphableModel, load_face_model
from facerf_cli.synth.head.mesh import HeadMesh
from facerf_cli.synth.head.shell import shell_head


@pytest.fixture(scope="session")
def model() -> MorphableModel:
    return load_face_model()


@pytest.fixture(scope="session")
def head(model: MorphableModel) -> HeadMesh:
    return shell_head(model.mean, gaze_deg=(0.0, 0.0), subdivisions=1)
