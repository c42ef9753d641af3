"""Glasses sit before the eyes and off the skin; headwear covers the skull and leaves the face free."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh

from facerf_cli.face.morphable import MorphableModel
from facerf_cli.portrait.parse import class_index
from facerf_cli.synth.bank.heads import mean_coefficients
from facerf_cli.synth.head import glasses, worn
from facerf_cli.synth.head.body import chin_height_m, draw_body
from facerf_cli.synth.head.glasses import GLASSES, draw_glasses
from facerf_cli.synth.head.hair import grow_hair
from facerf_cli.synth.head.hair_styles import draw_style
from facerf_cli.synth.head.mesh import PARTS, HeadMesh
from facerf_cli.synth.head.worn import HEADWEAR, Headwear, draw_headwear
from tests.kinds import Patch


@pytest.fixture(scope="module")
def landmarks(model: MorphableModel) -> np.ndarray:
    alpha, beta = mean_coefficients(model)
    return model.landmarks(model.vertices(alpha[None], beta[None]))[0].numpy()


def require_sound(mesh: HeadMesh, part: str) -> None:
    assert (mesh.part == PARTS.index(part)).all()
    assert mesh.triangles.min() >= 0 and mesh.triangles.max() < len(mesh.vertices) < 10_000
    for field in (mesh.vertices, mesh.normals, mesh.uv, mesh.tangents):
        assert np.isfinite(field).all() and field.dtype == np.float32
    np.testing.assert_allclose(np.linalg.norm(mesh.normals, axis=-1), 1, atol=1e-4)
    a, b, c = (mesh.vertices[mesh.triangles[:, k]].astype(float) for k in range(3))
    agree = (np.cross(b - a, c - a) * mesh.normals[mesh.triangles].mean(1)).sum(-1)
    assert (agree > 0).mean() > 0.95


@pytest.mark.parametrize("kind", GLASSES)
def test_glasses_sit_in_front_of_the_eyes_and_not_in_the_skin(
    head: HeadMesh, landmarks: np.ndarray, kind: str, monkeypatch: Patch
) -> None:
    monkeypatch.setattr(glasses, "GLASSES", (kind,))
    frame = draw_glasses(head, landmarks, np.random.default_rng(2)).frame
    require_sound(frame, "frame")
    front = frame.vertices[frame.vertices[:, 2] > 0.09]
    eyes = landmarks[36:48]
    assert front[:, 0].min() < eyes[:, 0].min() and front[:, 0].max() > eyes[:, 0].max()
    assert front[:, 1].max() > eyes[:, 1].max()
    if kind != "half-rim":
        assert front[:, 1].min() < eyes[:, 1].min()
    assert eyes[:, 2].max() < front[:, 2].max() < eyes[:, 2].max() + 0.04
    assert frame.vertices[:, 2].min() < 0.02  # the temples reach the ears
    skin = head.part[head.triangles[:, 0]] == PARTS.index("skin")
    surface = trimesh.Trimesh(head.vertices, head.triangles[skin], process=False)
    for points, away in (
        (front[np.abs(front[:, 0]) < 0.05], np.array([0, 0, 1.0])),
        (frame.vertices[frame.vertices[:, 0] > 0.06], np.array([1.0, 0, 0])),
        (frame.vertices[frame.vertices[:, 0] < -0.06], np.array([-1.0, 0, 0])),
    ):
        covered = surface.ray.intersects_any(points, np.broadcast_to(away, points.shape))
        assert covered.mean() < 0.01


def test_the_same_numbers_give_the_same_things(head: HeadMesh, landmarks: np.ndarray) -> None:
    for draw in (
        lambda r: draw_glasses(head, landmarks, r).frame,
        lambda r: draw_body(head, r)[0],
        lambda r: draw_headwear(head, chin_height_m(head), r).mesh,
    ):
        first, second, other = (draw(np.random.default_rng(seed)) for seed in (1, 1, 2))
        assert np.array_equal(first.vertices, second.vertices)
        assert np.array_equal(first.triangles, second.triangles)
        assert first.vertices.shape != other.vertices.shape or not np.allclose(first.vertices, other.vertices)


def drawn(head: HeadMesh, kind: str, monkeypatch: Patch) -> Headwear:
    monkeypatch.setattr(worn, "HEADWEAR", (kind,))
    return draw_headwear(head, chin_height_m(head), np.random.default_rng(7))


@pytest.mark.parametrize("kind", HEADWEAR)
def test_it_covers_the_skull_and_not_the_face(head: HeadMesh, kind: str, monkeypatch: Patch) -> None:
    worn = drawn(head, kind, monkeypatch)
    assert worn.kind == kind
    assert (worn.mesh.part == PARTS.index("hat")).all() and (worn.mesh.label == class_index("headwear")).all()
    surface = trimesh.Trimesh(worn.mesh.vertices, worn.mesh.triangles, process=False)
    skin = head.vertices[head.part == PARTS.index("skin")].astype(float)
    normals = head.normals[head.part == PARTS.index("skin")].astype(float)
    crown = skin[:, 1] > 0.115
    assert surface.ray.intersects_any(skin[crown], normals[crown]).mean() > 0.99
    face = (np.abs(skin[:, 0]) < 0.045) & (np.abs(skin[:, 1]) < 0.06) & (skin[:, 2] > 0.08)
    ahead = np.broadcast_to([0.0, 0, 1], skin[face].shape)
    assert not surface.ray.intersects_any(skin[face], ahead).any()


@pytest.mark.parametrize("kind", HEADWEAR)
@pytest.mark.parametrize("style_name", ["curly", "long", "short"])
def test_hair_stays_under_it(head: HeadMesh, kind: str, style_name: str, monkeypatch: Patch) -> None:
    worn = drawn(head, kind, monkeypatch)
    random = np.random.default_rng(2)
    style = draw_style(random, style_name)
    whole = grow_hair(head, worn.flat(replace(style, wisps=style.wisps // 4)), random)
    hair = worn.uncovered(whole)
    if kind == "headscarf":
        assert not len(hair.vertices)
        return
    surface = trimesh.Trimesh(worn.mesh.vertices, worn.mesh.triangles, process=False)
    top = hair.vertices[hair.vertices[:, 1] > 0.115].astype(float)
    outward = top - worn.hull.middle
    assert len(top) and surface.ray.intersects_any(top, outward).mean() > 0.98
    assert 0.3 < len(hair.vertices) / len(whole.vertices) <= 1
