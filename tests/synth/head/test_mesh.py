"""Classes of the vertices of a head: lips, brows, ears and neck are where they belong."""

import numpy as np

from facerf_cli.face.topology import LANDMARKS_M
from facerf_cli.portrait.classes import CLASSES, class_index
from facerf_cli.synth.head.mesh import PARTS, HeadMesh, ears_of, part_class, skin_classes


def near(head: HeadMesh, place_m: np.ndarray) -> str:
    """Class of the skin nearest to a place."""
    skin = np.flatnonzero(head.part == PARTS.index("skin"))
    return CLASSES[head.label[skin[np.linalg.norm(head.vertices[skin] - place_m, axis=-1).argmin()]]]


def test_every_part_has_a_class_and_below_the_jaw_is_neck() -> None:
    assert {CLASSES[part_class(part)] for part in PARTS} <= set(CLASSES)
    assert CLASSES[part_class("frame")] == "glasses" and CLASSES[part_class("teeth")] == "mouth"
    ball = np.array([[0.07, 0.0, 0.0], [0.095, 0.0, -0.005], [0.0, 0.0, 0.115], [0.085, 0.12, 0.0]])
    assert ears_of(ball).tolist() == [False, True, False, False]
    u = np.linspace(-0.4, 1.4, 19)
    high, low = (skin_classes(np.stack([u, np.full(19, v)], -1)) for v in (0.5, 1.1))
    assert (low == class_index("neck")).all() and not (high == class_index("neck")).any()


def test_landmarks_lie_on_their_classes_and_ears_on_both_sides(head: HeadMesh) -> None:
    assert near(head, LANDMARKS_M[30]) == "skin"  # tip of the nose
    assert near(head, (LANDMARKS_M[51] + LANDMARKS_M[62]) / 2) == "lips"
    assert near(head, (LANDMARKS_M[57] + LANDMARKS_M[66]) / 2) == "lips"
    assert near(head, LANDMARKS_M[19]) == near(head, LANDMARKS_M[24]) == "brows"
    assert near(head, LANDMARKS_M[2] + [0.006, 0, 0.006]) == "skin"
    assert near(head, np.array([0, -0.12, 0.06])) == "neck"
    assert near(head, np.array([0, -0.1, -0.06])) == "neck"
    ears = head.vertices[head.label == class_index("ears")]
    for sign in (-1, 1):
        ear = ears[ears[:, 0] * sign > 0]
        assert 0.04 < np.ptp(ear[:, 1]) < 0.09
        assert np.median(np.abs(ear[:, 0])) > 0.07 and -0.05 < ear[:, 2].mean() < 0.02
