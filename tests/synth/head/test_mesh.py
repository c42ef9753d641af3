"""Classes of the vertices of a head: lips, brows, ears and neck are where they belong; subdivision."""

import numpy as np
import trimesh

from facerf_cli.face.topology import LANDMARKS_M
from facerf_cli.portrait.parse import CLASSES, class_index
from facerf_cli.synth.head.mesh import PARTS, HeadMesh, loop_step, part_class, skin_classes


def near(head: HeadMesh, place_m: np.ndarray) -> str:
    """Class of the skin nearest to a place."""
    skin = np.flatnonzero(head.part == PARTS.index("skin"))
    return CLASSES[head.label[skin[np.linalg.norm(head.vertices[skin] - place_m, axis=-1).argmin()]]]


def test_every_part_has_a_class_and_below_the_jaw_is_neck() -> None:
    assert {CLASSES[part_class(part)] for part in PARTS} <= set(CLASSES)
    assert CLASSES[part_class("frame")] == "glasses" and CLASSES[part_class("teeth")] == "mouth"
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


def test_loop_subdivision_keeps_what_it_must_and_sheets_flat():
    mesh = trimesh.creation.icosphere(subdivisions=1)
    step, triangles = loop_step(np.asarray(mesh.faces), len(mesh.vertices))
    assert np.allclose(step @ np.ones(len(mesh.vertices)), 1)
    fine = trimesh.Trimesh(step @ mesh.vertices, triangles, process=False)
    assert fine.is_watertight and fine.volume > 0 and fine.euler_number == 2
    known = trimesh.remesh.subdivide_loop(mesh.vertices, mesh.faces, iterations=1)[0]
    assert np.allclose(np.sort(np.linalg.norm(known, axis=1)), np.sort(np.linalg.norm(fine.vertices, axis=1)))
    y, x = np.mgrid[:5, :5]
    points = np.stack([x, y, x + 2 * y], -1).reshape(-1, 3).astype(float)
    corner = (np.arange(4)[:, None] * 5 + np.arange(4)).reshape(-1)
    triangles = np.concatenate(
        [np.stack([corner, corner + 1, corner + 6], -1), np.stack([corner, corner + 6, corner + 5], -1)]
    )
    fine = loop_step(triangles, 25)[0] @ points
    assert np.allclose(fine[:, 2], fine[:, 0] + 2 * fine[:, 1])
    assert fine[:, 0].min() > -1e-9 and (np.abs(fine[:, 0]) < 1e-9).sum() == 9 - 2  # corners are rounded
