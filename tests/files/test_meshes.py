"""Meshes on disk: both formats come back with the same shape, and their texture the right way up."""

from pathlib import Path

import numpy as np
import pytest
import trimesh

from facerf_cli.files.meshes import TexturedMesh, write_glb, write_obj
from facerf_cli.files.write import write_display

# A quad of two triangles; the texture is red in the top left, green in the top right, black below.
UV = np.array([[0, 0], [1, 0], [0, 1], [1, 1]], np.float32)
VERTICES = np.stack([UV[:, 0], 1 - UV[:, 1], 0 * UV[:, 0]], -1) * 0.1
TRIANGLES = np.array([[0, 2, 3], [0, 3, 1]])
SIDE = 64


def quad() -> TexturedMesh:
    texture = np.zeros((SIDE, SIDE, 3), np.uint8)
    texture[: SIDE // 2, : SIDE // 2, 0] = 255
    texture[: SIDE // 2, SIDE // 2 :, 1] = 255
    normals = np.tile(np.array([0, 0, 1], np.float32), (4, 1))
    return TexturedMesh(VERTICES, normals, TRIANGLES, UV, texture, {"facerf:synthetic": 1})


def reload(path: Path) -> trimesh.Trimesh:
    return trimesh.load(path, force="mesh", process=False)


def written(folder: Path, kind: str) -> Path:
    mesh, path = quad(), folder / f"a quad.{kind}"
    if kind == "glb":
        write_glb(path, mesh)
    else:
        write_obj(path, mesh, "a quad_texture.png")
        write_display(folder / "a quad_texture.png", (mesh.texture_srgb / 255).astype(np.float32))
    return path


@pytest.mark.parametrize("kind", ["glb", "obj"])
def test_shape_and_texture_come_back(tmp_path: Path, kind: str) -> None:
    mesh = reload(written(tmp_path, kind))
    order = [np.abs(VERTICES - vertex).sum(-1).argmin() for vertex in mesh.vertices]
    assert sorted(order) == [0, 1, 2, 3] and np.allclose(mesh.vertices, VERTICES[order], atol=1e-6)
    assert np.allclose(mesh.face_normals, [0, 0, 1])  # counter-clockwise from outside
    assert np.allclose(mesh.vertex_normals, [0, 0, 1])
    material = mesh.visual.material
    image = getattr(material, "baseColorTexture", None) or material.image
    colours = trimesh.visual.color.uv_to_color(np.array([[0.1, 0.9], [0.9, 0.9], [0.1, 0.1]]), image)
    assert colours[:, :3].tolist() == [[255, 0, 0], [0, 255, 0], [0, 0, 0]]  # (u, v up)
    top_left = order.index(0)
    assert np.allclose(mesh.visual.uv[top_left], [0, 1])


def test_obj_names_its_material_and_glb_keeps_provenance(tmp_path: Path) -> None:
    path = written(tmp_path, "obj")
    text = path.read_text()
    assert "mtllib a quad.mtl" in text and "usemtl face" in text and "facerf:synthetic: 1" in text
    assert "map_Kd a quad_texture.png" in path.with_suffix(".mtl").read_text()
    assert sorted(file.name for file in tmp_path.iterdir()) == [
        "a quad.mtl",
        "a quad.obj",
        "a quad_texture.png",
    ]
    scene = trimesh.load(written(tmp_path, "glb"))
    assert scene.metadata["facerf:synthetic"] == 1
