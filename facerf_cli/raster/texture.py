"""Between pictures and UV textures: unwrap, inpaint, normals, render.

A mesh here is a uniform grid in UV: vertex (row i, column j) of a side x side grid sits at
(j, i) / (side - 1). Textures are [C, T, T]; u runs right, v down, texel (row i, column j) is centred at
((j + 0.5) / T, (i + 0.5) / T).
"""

import math
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor

from facerf_cli.raster.camera import PIXEL_CENTRE, Camera, pixel_rays, project
from facerf_cli.raster.rasterize import interpolate, rasterize

_TINY = 1e-12


@dataclass(frozen=True)
class UnwrapSettings:
    """When a texel counts as seen."""

    hidden_m: float = 0.0025  # a texel is hidden if something lies this much in front of it
    unseen_cosine: float = 0.12  # to the viewing ray; at and below it a texel counts as unseen,
    seen_cosine: float = 0.35  # at and above it as seen, smoothly in between
    depth_side_px: int = 512  # the depth map is at least this long, whatever the picture's size
    samples: int = 4  # at most samples x samples per texel; a finer picture is averaged down first


def vertex_normals(vertices: Tensor, triangles: Tensor) -> Tensor:
    """Unit normals [V, 3], area-weighted means over the triangles; +z where there is no area at all."""
    a, b, c = vertices[triangles].unbind(1)
    area_normals = torch.linalg.cross(b - a, c - a).repeat_interleave(3, 0)
    return _unit(torch.zeros_like(vertices).index_add(0, triangles.reshape(-1), area_normals))


def _unit(vectors: Tensor) -> Tensor:
    """Unit vectors [..., 3]; zero vectors become +z, without a gradient."""
    length2 = _dot(vectors, vectors)
    zero = (length2 == 0)[..., None]
    up = torch.tensor([0.0, 0, 1], dtype=vectors.dtype, device=vectors.device)
    length = torch.where(zero, torch.ones_like(length2)[..., None], length2[..., None]).sqrt()
    return torch.where(zero, up, vectors / length)


def _dot(a: Tensor, b: Tensor) -> Tensor:
    return a[..., 0] * b[..., 0] + a[..., 1] * b[..., 1] + a[..., 2] * b[..., 2]  # sum(-1) is far slower


def texel_centres_uv(
    side: int, dtype: torch.dtype = torch.float32, device: torch.device | str = "cpu"
) -> Tensor:
    """(u, v) of every texel's centre [T, T, 2]."""
    centre = (torch.arange(side, dtype=dtype, device=device) + 0.5) / side
    v, u = torch.meshgrid(centre, centre, indexing="ij")
    return torch.stack([u, v], -1)


def bake_attributes(attributes: Tensor, grid_side: int, texture_side: int) -> Tensor:
    """Vertex attributes [V, C] of a uniform grid at the texels' centres [C, T, T]."""
    if len(attributes) != grid_side**2:
        raise ValueError(f"a grid of side {grid_side} has {grid_side**2} vertices, not {len(attributes)}")
    grid = attributes.T.reshape(1, -1, grid_side, grid_side)
    uv = texel_centres_uv(texture_side, attributes.dtype, attributes.device)
    return F.grid_sample(grid, (2 * uv - 1)[None], align_corners=True)[0]


def normal_map(vertices_camera: Tensor, triangles: Tensor, texture_side: int) -> Tensor:
    """Camera-space unit normals of a uniform grid mesh in UV [3, T, T]."""
    normals = vertex_normals(vertices_camera, triangles)
    baked = bake_attributes(normals, math.isqrt(len(normals)), texture_side)
    return _unit(baked.permute(1, 2, 0)).permute(2, 0, 1)


def sample_texture(texture: Tensor, uv: Tensor) -> Tensor:
    """Texture [C, T, T] (or any picture) at (u, v) [H, W, 2], bilinear, border-clamped: [H, W, C]."""
    grid = (2 * uv - 1)[None].to(texture.dtype)
    return F.grid_sample(texture[None], grid, padding_mode="border", align_corners=False)[0].permute(1, 2, 0)


def render_texture(
    texture: Tensor, vertices_camera: Tensor, triangles: Tensor, uv: Tensor, camera: Camera
) -> tuple[Tensor, Tensor]:
    """Picture [H, W, C] of a textured mesh, black beyond it, and coverage [H, W], 0 or 1 at its centres.

    `uv` [V, 2] are the vertices'. Differentiable in the texture and, by the interpolation, in the vertices.
    """
    fragments = rasterize(vertices_camera, triangles, camera)
    coverage = fragments.covered.to(texture.dtype)
    image = sample_texture(texture, interpolate(uv, triangles, fragments))
    return image * coverage[..., None], coverage


def unwrap(
    image: Tensor,
    vertices_camera: Tensor,
    triangles: Tensor,
    camera: Camera,
    texture_side: int,
    settings: UnwrapSettings = UnwrapSettings(),
) -> tuple[Tensor, Tensor]:
    """Picture [C, H, W] to the texture [C, T, T] of a uniform grid mesh, and how well it is seen [T, T].

    A texel is the mean of up to samples x samples points in it, so that it averages over the pixels that it
    covers; hidden points do not enter, and the others weigh by how squarely they are seen. The texture is 0
    where nothing is seen. Differentiable in the picture and the vertices; visibility is a constant.
    """
    if image.shape[-2:] != (camera.height_px, camera.width_px):
        raise ValueError(
            f"the picture is {tuple(image.shape)}, the camera's {camera.height_px, camera.width_px}"
        )
    image, camera, samples = _match_scale(image, vertices_camera, camera, texture_side, settings.samples)
    side = math.isqrt(len(vertices_camera))
    points = bake_attributes(vertices_camera, side, texture_side * samples).permute(1, 2, 0)
    with torch.no_grad():
        weight = _visibility(points, vertices_camera, triangles, camera, settings)
    size = torch.tensor([camera.width_px, camera.height_px], dtype=points.dtype, device=points.device)
    colour = sample_texture(image, project(points, camera) / size).permute(2, 0, 1)
    weight = weight.to(image.dtype)
    visible = F.avg_pool2d(weight[None], samples)[0]
    texture = F.avg_pool2d(colour * weight, samples) / visible.clamp(min=_TINY)
    return texture, visible


def _match_scale(
    image: Tensor, vertices_camera: Tensor, camera: Camera, texture_side: int, samples: int
) -> tuple[Tensor, Camera, int]:
    """Average the picture down by a power of two, and choose the samples a texel, for a sample a pixel."""
    side = math.isqrt(len(vertices_camera))
    px = bake_attributes(project(vertices_camera.detach(), camera), side, texture_side)
    step_px = torch.cat([px.diff(dim=1).norm(dim=0).flatten(), px.diff(dim=2).norm(dim=0).flatten()])
    step = float(step_px.nan_to_num(0, 0).sort().values[int(0.95 * len(step_px))])
    shrink = 2 ** max(0, math.ceil(math.log2(max(step, 1) / samples)))
    if shrink > 1:
        camera = Camera(
            camera.focal_px / shrink,
            math.ceil(camera.width_px / shrink),
            math.ceil(camera.height_px / shrink),
            camera.cx_px / shrink,
            camera.cy_px / shrink,
        )
        image = F.avg_pool2d(image, shrink, ceil_mode=True, count_include_pad=False)
    return image, camera, min(samples, max(1, math.ceil(step / shrink)))


def _visibility(
    points: Tensor, vertices_camera: Tensor, triangles: Tensor, camera: Camera, settings: UnwrapSettings
) -> Tensor:
    """How well each point [T, T, 3] of the mesh is seen [T, T] in 0..1."""
    normals = normal_map(vertices_camera, triangles, points.shape[0]).permute(1, 2, 0)
    cosine = -_dot(normals, points) / _dot(points, points).sqrt()
    fade = ((cosine - settings.unseen_cosine) / (settings.seen_cosine - settings.unseen_cosine)).clamp(0, 1)
    px = project(points, camera)
    size = torch.tensor([camera.width_px, camera.height_px], dtype=px.dtype, device=px.device)
    inside = ((px >= 0) & (px <= size)).all(-1) & (points[..., 2] < 0)
    nearer_m = _in_front_by(points, normals, vertices_camera, triangles, _depth_camera(camera, settings))
    return (fade * fade * (3 - 2 * fade)) * (inside & (nearer_m < settings.hidden_m))


def _depth_camera(camera: Camera, settings: UnwrapSettings) -> Camera:
    scale = max(1.0, settings.depth_side_px / max(camera.width_px, camera.height_px))
    width_px, height_px = math.ceil(camera.width_px * scale), math.ceil(camera.height_px * scale)
    return Camera(camera.focal_px * scale, width_px, height_px, camera.cx_px * scale, camera.cy_px * scale)


def _in_front_by(
    points: Tensor, normals: Tensor, vertices_camera: Tensor, triangles: Tensor, camera: Camera
) -> Tensor:
    """By how many metres the nearest surface lies in front of each point [T, T]; negative if behind.

    Depth is compared where the depth map has it, at the pixel's centre: the point is moved there along its
    own tangent plane, so that a slanted surface does not hide itself.
    """
    depth_m = rasterize(vertices_camera, triangles, camera).depth_m
    px = project(points, camera).nan_to_num(0, 0, 0)
    column = px[..., 0].floor().long().clamp(0, camera.width_px - 1)
    row = px[..., 1].floor().long().clamp(0, camera.height_px - 1)
    ray = pixel_rays(torch.stack([column, row], -1) + PIXEL_CENTRE, camera)
    toward = _dot(normals, ray).clamp(max=-_TINY)
    plane_depth_m = _dot(normals, points) / toward
    return plane_depth_m - depth_m[row, column]


def inpaint(texture: Tensor, visible: Tensor) -> Tensor:
    """Texture [C, T, T] with its unseen texels filled from the seen ones nearest to them, by push and pull.

    `visible` [T, T] in 0..1 is how far each texel is trusted; what is fully seen is returned as it was.
    """
    if min(visible.shape) == 1:
        return texture * (visible > 0)
    weight = F.avg_pool2d(visible[None], 2, ceil_mode=True, count_include_pad=False)
    coarse = F.avg_pool2d(texture * visible, 2, ceil_mode=True, count_include_pad=False)
    coarse = coarse / weight.clamp(min=_TINY)
    filled = inpaint(coarse, (4 * weight[0]).clamp(max=1))  # one seen texel out of four is enough below
    fill = F.interpolate(filled[None], size=visible.shape, mode="bilinear", align_corners=False)[0]
    return visible * texture + (1 - visible) * fill
