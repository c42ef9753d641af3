"""Write the files of `facerf fit-geometry`: meshes, textures, normals and fits of a photo's faces."""

import math
from pathlib import Path
from typing import Any

import numpy as np

from facerf_cli.batch.inputs import Item
from facerf_cli.face.fit import save_fit
from facerf_cli.face.topology import grid_triangles, grid_uv
from facerf_cli.face.view import draw_fit
from facerf_cli.files.atomic import atomic_path
from facerf_cli.files.meshes import TexturedMesh, write_glb, write_obj
from facerf_cli.files.read import LinearImage
from facerf_cli.files.write import write_display, write_exr
from facerf_cli.image.colour import srgb_to_linear, to_display
from facerf_cli.raster.camera import CROP_FOCAL_PER_SIDE
from facerf_cli.raster.texture import vertex_normals
from facerf_cli.work.photo_options import PhotoOptions
from facerf_cli.work.photos import (
    FittedFace,
    face_model,
    provenance,
    read_photo,
    write_each,
)


def write_fits(item: Item, options: PhotoOptions) -> tuple[list[str], dict[str, Any]]:
    """Fit and write each chosen face of a photo; return tags, and facts for the report."""
    image = read_photo(item, options)

    def write(face: FittedFace) -> dict[str, Any]:
        _write_fit(item, image, face, options)
        return {}

    return write_each(item, image, options, write)


def _write_fit(item: Item, image: LinearImage, face: FittedFace, options: PhotoOptions) -> None:
    def path(ending: str) -> Path:
        return item.output(face.tag + ending)

    metadata, uv = provenance(item, options), face.head.face
    texture, normals = (tensor.permute(1, 2, 0).numpy() for tensor in (uv.texture, uv.normals))
    write_exr(path("_texture.exr"), texture, layers={"visible": uv.visible.numpy()}, metadata=metadata)
    write_display(path("_texture.png"), texture, "auto", metadata=metadata)
    write_exr(path("_normals.exr"), normals, metadata=metadata)
    write_display(path("_normals.png"), srgb_to_linear(0.5 + 0.5 * normals), metadata=metadata)
    mesh = _mesh(face, to_display(texture), options, metadata)
    fov_deg = math.degrees(2 * math.atan(0.5 / CROP_FOCAL_PER_SIDE))
    write_glb(path("_mesh.glb"), mesh, (fov_deg, np.linalg.inv(face.fit.head_to_camera)))
    write_obj(path("_mesh.obj"), mesh, path("_texture.png").name)
    overlay = draw_fit(image.pixels, face.fit, face_model(options))
    write_display(path("_fit.jpg"), overlay, metadata=metadata)
    with atomic_path(path("_fit.npz")) as temporary:
        save_fit(temporary, face.fit, metadata)


def _mesh(
    face: FittedFace, texture_srgb: np.ndarray, options: PhotoOptions, metadata: dict[str, Any]
) -> TexturedMesh:
    """Return the fitted mesh in the head frame; the fit contains its pose."""
    vertices = face_model(options).vertices(face.fit.alpha[None], face.fit.beta[None])[0]
    return TexturedMesh(
        vertices_m=vertices.numpy(),
        normals=vertex_normals(vertices, grid_triangles()).numpy(),
        triangles=grid_triangles().numpy(),
        uv=grid_uv().numpy(),
        texture_srgb=texture_srgb,
        metadata=metadata,
    )
