"""The body continues the neck; garments cover it, and neither lets the other show through."""

import numpy as np
import pytest
import torch

from facerf_cli.portrait.parse import class_index
from facerf_cli.raster.camera import Camera
from facerf_cli.raster.rasterize import rasterize
from facerf_cli.synth.head import body, worn
from facerf_cli.synth.head.body import chin_height_m, draw_body
from facerf_cli.synth.head.mesh import GARMENTS, PARTS, HeadMesh, packed_mesh

SIDE_PX, SIDE_M, FAR_M = 160, 0.56, 60.0


def front(mesh: HeadMesh) -> np.ndarray:
    """Classes [160, 160] in a picture, almost orthographic, of 56 cm; the chin is above its middle."""
    lens = Camera(SIDE_PX * FAR_M / SIDE_M, SIDE_PX, SIDE_PX, SIDE_PX / 2, SIDE_PX / 2)
    vertices = torch.from_numpy(mesh.vertices + np.array([0, 0.13, -FAR_M], np.float32))
    seen = rasterize(vertices, torch.from_numpy(mesh.triangles), lens)
    nearest = torch.from_numpy(mesh.triangles)[seen.triangle, seen.barycentric.argmax(-1)]
    return np.where(seen.covered.numpy(), mesh.label[nearest.numpy()], class_index("background"))


def rows(high_m: float, low_m: float) -> slice:
    """Rows of `front` between two heights of the head frame."""
    return slice(*(round(SIDE_PX * (0.5 - (y + 0.13) / SIDE_M)) for y in (high_m, low_m)))


def columns(half_m: float) -> slice:
    middle, reach = SIDE_PX // 2, round(SIDE_PX * half_m / SIDE_M)
    return slice(middle - reach, middle + reach)


@pytest.fixture
def plain(monkeypatch: pytest.MonkeyPatch) -> pytest.MonkeyPatch:
    """Nobody wears a strapless top or anything around the neck."""
    monkeypatch.setattr(body, "_STRAPLESS_SHARE", 0.0)
    monkeypatch.setattr(body, "_NECKWEAR_SHARE", 0.0)
    return monkeypatch


@pytest.mark.parametrize("name", GARMENTS)
def test_a_garment_covers_the_chest_and_leaves_no_hole_at_the_neck(
    head: HeadMesh, name: str, plain: pytest.MonkeyPatch
) -> None:
    plain.setattr(body, "GARMENTS", (name,))
    dressed, found = draw_body(head, np.random.default_rng(3))
    assert found == name
    assert dressed.triangles.max() < len(dressed.vertices) < 250_000
    np.testing.assert_allclose(np.linalg.norm(dressed.normals, axis=-1), 1, atol=1e-4)
    classes = front(dressed)
    chin = chin_height_m(head)
    chest = classes[rows(chin - 0.17, chin - 0.27), columns(0.10)]
    assert (chest == class_index("garment")).mean() > 0.995
    throat = classes[rows(chin - 0.01, chin - 0.20), columns(0.03)]
    assert not (throat == class_index("background")).any()
    shoulders = classes[rows(chin - 0.12, chin - 0.14)] != class_index("background")
    assert 0.36 < shoulders.sum(1).max() * SIDE_M / SIDE_PX < 0.56


def test_bare_shoulders_are_one_surface_with_the_neck(head: HeadMesh, plain: pytest.MonkeyPatch) -> None:
    plain.setattr(body, "_STRAPLESS_SHARE", 1.0)
    dressed, found = draw_body(head, np.random.default_rng(3))
    chin = chin_height_m(head)
    classes = front(dressed)
    assert found == "strapless"
    assert (classes[rows(chin - 0.03, chin - 0.10), columns(0.04)] == class_index("neck")).all()
    assert (classes[rows(chin - 0.2, chin - 0.25), columns(0.08)] == class_index("garment")).mean() > 0.99


@pytest.mark.parametrize("kind", worn.NECKWEAR)
def test_neckwear_lies_around_the_neck(head: HeadMesh, kind: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(worn, "NECKWEAR", (kind,))
    chin = chin_height_m(head)
    cloth = worn.draw_neckwear(head, chin, np.random.default_rng(4))
    assert (cloth.part == PARTS.index("cloth")).all()
    assert cloth.vertices[:, 1].max() < chin and cloth.vertices[:, 1].min() > chin - 0.17
    a, b, c = (cloth.vertices[cloth.triangles[:, k]].astype(float) for k in range(3))
    outward = (a + b + c) / 3 * [1, 0, 1]
    outer = np.linalg.norm(outward, axis=-1) > np.quantile(np.linalg.norm(outward, axis=-1), 0.6)
    assert ((np.cross(b - a, c - a) * outward).sum(-1)[outer] > 0).mean() > 0.9


def test_packed_shapes_hang_on_the_same_shoulders() -> None:
    def top(vertices: np.ndarray) -> float:
        near = (np.abs(vertices[:, 0]) > 0.13) & (np.abs(vertices[:, 0]) < 0.16)
        return float(vertices[near, 1].max())

    skin, _ = packed_mesh("body")
    for name in GARMENTS:
        vertices, triangles = packed_mesh(name)
        assert triangles.max() == len(vertices) - 1
        assert -0.01 < top(vertices) - top(skin) < 0.02, name
