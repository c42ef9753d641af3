"""What is said of the lights, by how each camera finds them against the face."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from facerf_cli.capture.checks.rig import RigFit, Turn, check_rigs
from facerf_cli.capture.checks.shading import parabola_vertex


def rig(camera: str, turned_deg: float = 0.0, looking_away: float = 0.0, mirrored: float = 0.8) -> RigFit:
    """With a likeness of 0.9 to the face, mirrored of `mirrored`."""
    rotation = Rotation.from_euler("y", turned_deg, degrees=True).as_matrix()
    return RigFit(camera, Turn(rotation, 0.9), Turn(np.eye(3), mirrored), rotation, looking_away, "")


@pytest.mark.parametrize(
    ("rigs", "said"),
    [
        ([rig("C0"), rig("C1", 15), rig("C2")], []),
        ([rig("C0"), rig("C1", 60, 0.2), rig("C2")], [("camera", "C1")]),
        ([rig("C0"), rig("C1", 40, 0.01), rig("C2")], []),  # a face laid on wrongly from the side
        ([rig("C0"), rig("C1", mirrored=0.95), rig("C2")], [("camera", "C1")]),
        ([rig("C0", 60, 0.2), rig("C1")], [("camera", "C0")]),
        ([rig("C0", 35), rig("C1", 35), rig("C2")], [("rig", "C0")]),
        ([rig("C0"), rig("C1", 28), rig("C2", -25)], []),  # two such, one from the left
        ([rig("C0"), rig("C1", 50, 0.1), rig("C2", -50, 0.1)], [("camera", "C1"), ("camera", "C2")]),
        ([rig("C0"), rig("C1", mirrored=0.95), rig("C2", mirrored=0.95)], [("rig", "C1")]),
        ([rig("C0", 25)], [("rig", "C0")]),
        ([], []),
    ],
)
def test_the_rig_is_blamed_where_most_cameras_agree(rigs: list[RigFit], said: list[tuple[str, str]]) -> None:
    assert [(found.check, found.camera) for found in check_rigs("s", rigs)] == said


def test_a_turn_and_a_mirror_are_told_in_words() -> None:
    (found,) = check_rigs("s", [rig("C0", 50)])
    assert "the lights are turned by 50 degrees against the face" in found.words
    (found,) = check_rigs("s", [rig("C0", 50, mirrored=0.95)])
    assert "the lights are mirrored left to right against" in found.words


@pytest.mark.parametrize("sign", [1, -1])
def test_the_vertex_of_a_parabola_that_is_sampled_unevenly(sign: int) -> None:
    x = np.array([0.0, 1.0, 1.5, 3.0])
    y = sign * (x - 1.3) ** 2
    assert parabola_vertex(x, y, 2) == pytest.approx(1.3)
    assert parabola_vertex(x, y, 0) == 0.0 and parabola_vertex(x, y, 3) == 3.0
    assert parabola_vertex(x, np.ones(4), 2) == 1.5
