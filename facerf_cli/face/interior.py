"""The masked interior of the face M_t(omega_h), computed with the renderer (paper, 'Photometric loss').

The region `face` of the chart without its soft rim: inside the jaw line and the forehead. Brows, eyes and the
mouth are in it, for the paper leaves nothing out. Of the mesh only what looks at the camera counts.
"""

from functools import cache

import torch
from torch import Tensor

from facerf_cli.face.regions import region_mask
from facerf_cli.face.topology import grid_triangles
from facerf_cli.raster.rasterize import Fragments, front_facing
from facerf_cli.raster.texture import sample_texture


@cache
def interior_texture(side: int) -> Tensor:
    """The interior in the chart [1, T, T]: 0 on the outline of the region `face`, 1 from 8 mm inside it."""
    return (2 * region_mask("face", side) - 1).clamp_min(0)[None]


@torch.no_grad()
def interior_mask(vertices_camera: Tensor, fragments: Fragments, uv: Tensor, texture_side: int) -> Tensor:
    """M_t [1, H, W] in 0..1 of a mesh [V, 3] whose fragments and (u, v) [H, W, 2] each pixel sees."""
    front = front_facing(vertices_camera, grid_triangles().to(vertices_camera.device))
    seen = fragments.covered & front[fragments.triangle]  # the triangle is -1 where nothing is seen
    inside = sample_texture(interior_texture(texture_side).to(uv.device), uv)[..., 0]
    return (inside * seen)[None]
