"""Arms turn about their joints as rigid bodies do, and nothing else moves."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from facerf_cli.portrait.parse import class_index
from facerf_cli.synth.head import arms
from facerf_cli.synth.head.arms import bend_arms
from facerf_cli.synth.head.body import draw_body
from facerf_cli.synth.head.mesh import WHOLE, HeadMesh, packed_mesh, smooth_normals, strandless

STILL = Rotation.identity()
ORIGIN_M, GROWN = np.array([0.01, -0.1, 0.02]), np.array([1.05, 1.0, 0.95])


@pytest.fixture(scope="module")
def resting() -> HeadMesh:
    vertices, faces = packed_mesh(WHOLE + "body")
    placed = vertices * GROWN + ORIGIN_M
    return strandless("skin", placed, smooth_normals(placed, faces), faces, np.zeros((len(placed), 2)))


def bent(person: HeadMesh, shoulder: Rotation, elbow: Rotation, monkeypatch: pytest.MonkeyPatch) -> HeadMesh:
    monkeypatch.setattr(arms, "_draw_pose", lambda random: (shoulder, elbow))
    return bend_arms(person, ORIGIN_M, GROWN, np.random.default_rng(0))


def test_hands_turn_about_elbow_and_shoulder(resting: HeadMesh, monkeypatch: pytest.MonkeyPatch) -> None:
    """In MakeHuman's decimetres: the elbow first, then all of the arm; the right hand in a mirror."""
    shoulder = Rotation.from_euler("xz", [-50, -30], degrees=True)
    elbow = Rotation.from_euler("y", 40, degrees=True)
    person = bent(resting, shoulder, elbow, monkeypatch)
    of_shoulder, of_elbow = np.array([1.68, 5.25, 0.15]), np.array([3.13, 3.49, 0.13])

    def places(mesh: HeadMesh) -> np.ndarray:
        return (mesh.vertices - ORIGIN_M) / GROWN * 10 + [0, 5.95, 0.22]

    for side in (1, -1):
        hand = resting.vertices[:, 0] * side > 0.48
        at = places(resting)[hand] * [side, 1, 1]
        turned = of_elbow + elbow.apply(at - of_elbow)
        wanted = of_shoulder + shoulder.apply(turned - of_shoulder)
        np.testing.assert_allclose(places(person)[hand] * [side, 1, 1], wanted, atol=1e-4)
        assert (person.label[hand] == class_index("hand")).all()


def test_trunk_and_resting_arms_stay(resting: HeadMesh, monkeypatch: pytest.MonkeyPatch) -> None:
    person = bent(resting, STILL, STILL, monkeypatch)
    np.testing.assert_allclose(person.vertices, resting.vertices, atol=1e-6)
    turned = bent(resting, Rotation.from_euler("z", -40, degrees=True), STILL, monkeypatch)
    trunk = np.abs(resting.vertices[:, 0]) < 0.11
    assert trunk.sum() > 1000
    np.testing.assert_array_equal(turned.vertices[trunk], resting.vertices[trunk])
    np.testing.assert_array_equal(turned.normals[trunk], resting.normals[trunk])


def test_bent_limbs_are_as_long_and_as_thick(head: HeadMesh, monkeypatch: pytest.MonkeyPatch) -> None:
    """Edges of a dressed person keep their lengths but where a joint bends."""
    monkeypatch.setattr(arms, "_draw_pose", lambda random: (STILL, STILL))
    resting, _ = draw_body(head, np.random.default_rng(3), arms=True)
    monkeypatch.undo()
    person, _ = draw_body(head, np.random.default_rng(3), arms=True)

    def lengths(mesh: HeadMesh) -> np.ndarray:
        return np.linalg.norm(np.diff(mesh.vertices[mesh.triangles[:, :2]], axis=1)[:, 0], axis=-1)

    apart = person.vertices - resting.vertices
    arm = np.linalg.norm(apart, axis=1)[person.triangles[:, 0]] > 0.01
    ratio = lengths(person)[arm] / lengths(resting)[arm].clip(1e-6)
    assert arm.sum() > 5000 and np.quantile(ratio, 0.2) > 0.9 and np.quantile(ratio, 0.8) < 1.1
