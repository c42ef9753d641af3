"""Textured meshes, rendered for tests."""

from torch import Tensor

from facerf_cli.raster.camera import Camera
from facerf_cli.raster.rasterize import interpolate, rasterize
from facerf_cli.raster.texture import sample_texture


def render_texture(
    texture: Tensor, vertices_camera: Tensor, triangles: Tensor, uv: Tensor, camera: Camera
) -> tuple[Tensor, Tensor]:
    """Render a textured mesh to an image [H, W, C], black outside of it, and a coverage [H, W] of 0 or 1.

    Differentiable in the texture and, through the interpolation, in the vertices.

    Args:
        texture: [C, T, T].
        vertices_camera: [V, 3] in camera space, in metres.
        triangles: [F, 3].
        uv: (u, v) of the vertices [V, 2], v down.
        camera: The image's camera.
    """
    fragments = rasterize(vertices_camera, triangles, camera)
    coverage = fragments.covered.to(texture.dtype)
    image = sample_texture(texture, interpolate(uv, triangles, fragments))
    return image * coverage[..., None], coverage
