"""Textured meshes for other programs: binary glTF and Wavefront OBJ, in metres, y up."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from PIL import Image
from trimesh.visual import TextureVisuals
from trimesh.visual.material import PBRMaterial, SimpleMaterial

from facerf_cli.files.atomic import atomic_path


@dataclass(frozen=True, eq=False)
class TexturedMesh:
    """Triangle mesh with normals and a texture."""

    vertices_m: np.ndarray  # [V, 3]
    normals: np.ndarray  # [V, 3]
    triangles: np.ndarray  # [F, 3], counter-clockwise from outside
    uv: np.ndarray  # [V, 2], v down
    texture_srgb: np.ndarray  # [T, T, 3] uint8
    metadata: dict[str, Any]  # provenance


def write_glb(path: Path, mesh: TexturedMesh, camera: tuple[float, np.ndarray] | None = None) -> None:
    """Write a binary glTF with the texture on a rough dielectric.

    `camera` is square: its angle of view in degrees, and camera_to_mesh [4, 4]; it looks along -z.
    """
    image = Image.fromarray(mesh.texture_srgb)
    material = PBRMaterial("face", baseColorTexture=image, metallicFactor=0.0, roughnessFactor=1.0)
    scene = trimesh.Scene(metadata=mesh.metadata)
    scene.add_geometry(_with_material(mesh, material), geom_name="face")
    if camera is not None:
        scene.camera = trimesh.scene.Camera("photo", fov=(camera[0], camera[0]))
        scene.camera_transform = camera[1]
    with atomic_path(path) as temporary:
        temporary.write_bytes(scene.export(file_type="glb", include_normals=True))


def write_obj(path: Path, mesh: TexturedMesh, texture_name: str) -> None:
    """Write `path`, and an .mtl that names the texture's image, which the caller writes."""
    material = SimpleMaterial(image=Image.new("RGB", (1, 1)), name="face")  # needed to export UVs
    mtl_path = path.with_suffix(".mtl")
    header = "; ".join(f"{name}: {value}" for name, value in mesh.metadata.items())
    text = trimesh.exchange.obj.export_obj(
        _with_material(mesh, material), include_normals=True, mtl_name=mtl_path.name, header=header
    )
    with atomic_path(mtl_path) as temporary:
        temporary.write_text(f"newmtl face\nKa 0 0 0\nKd 1 1 1\nKs 0 0 0\nmap_Kd {texture_name}\n", "utf-8")
    with atomic_path(path) as temporary:
        temporary.write_text(text, "utf-8")


def _with_material(mesh: TexturedMesh, material: PBRMaterial | SimpleMaterial) -> trimesh.Trimesh:
    up = np.stack([mesh.uv[:, 0], 1 - mesh.uv[:, 1]], -1)  # trimesh and OBJ count v upward
    return trimesh.Trimesh(
        mesh.vertices_m,
        mesh.triangles,
        vertex_normals=mesh.normals,
        visual=TextureVisuals(up, material=material),
        process=False,
    )
