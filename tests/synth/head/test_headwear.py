"""Headwear covers the skull down to its edge, leaves the face free, and no hair pierces it."""

import numpy as np
import pytest
import trimesh

from facerf_cli.portrait.classes import class_index
from facerf_cli.synth.head import worn
from facerf_cli.synth.head.body import chin_height_m
from facerf_cli.synth.head.hair import grow_hair
from facerf_cli.synth.head.hair_styles import draw_style
from facerf_cli.synth.head.mesh import PARTS, HeadMesh
from facerf_cli.synth.head.worn import HEADWEAR, Headwear, draw_headwear


def drawn(head: HeadMesh, kind: str, monkeypatch: pytest.MonkeyPatch) -> Headwear:
    monkeypatch.setattr(worn, "HEADWEAR", (kind,))
    return draw_headwear(head, chin_height_m(head), np.random.default_rng(7))


@pytest.mark.parametrize("kind", HEADWEAR)
def test_it_covers_the_skull_and_not_the_face(
    head: HeadMesh, kind: str, monkeypatch: pytest.MonkeyPatch
) -> None:
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
def test_hair_stays_under_it(
    head: HeadMesh, kind: str, style_name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    worn = drawn(head, kind, monkeypatch)
    random = np.random.default_rng(2)
    whole = grow_hair(head, worn.flat(draw_style(random, style_name)), random)
    hair = worn.uncovered(whole)
    if kind == "headscarf":
        assert not len(hair.vertices)
        return
    surface = trimesh.Trimesh(worn.mesh.vertices, worn.mesh.triangles, process=False)
    top = hair.vertices[hair.vertices[:, 1] > 0.115].astype(float)
    outward = top - worn.hull.middle
    assert len(top) and surface.ray.intersects_any(top, outward).mean() > 0.98
    assert 0.3 < len(hair.vertices) / len(whole.vertices) <= 1
