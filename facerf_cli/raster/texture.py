"""Textures in UV space: render to an image, unwrap from an image, inpaint, and bake normals.

A mesh here is a uniform grid in UV: vertex (row i, column j) of a side x side grid is at
(j, i) / (side - 1). Meshes, images and textures may be those of a batch. Textures are [C, T, T]; u runs
right, v down, and the centre of texel (row i, column j) is at ((j + 0.5) / T, (i + 0.5) / T).
"""

import math
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from scipy.ndimage import gaussian_filter
from torch import Tensor

from facerf_cli.raster.camera import PIXEL_CENTRE, Camera, pixel_rays, project
from facerf_cli.raster.rasterize import interpolate, rasterize

_TINY = 1e-12  # avoids division by zero
_STEP_QUANTILE = 0.95  # of the distance between texels in an image, by which it is scaled down


@dataclass(frozen=True)
class UnwrapSettings:
    """Conditions for a texel to count as visible."""

    hidden_m: float = 0.0025  # a texel is hidden if a surface is this far in front of it
    unseen_cosine: float = 0.12  # of normal and viewing ray: invisible at and below this,
    seen_cosine: float = 0.35  # fully visible at and above this, smooth in between
    depth_side_px: int = 512  # least length of the depth map's longer side
    samples: int = 4  # at most samples x samples in a texel; a larger image is scaled down first
    measured: bool = True  # the texels' sizes choose the image's scale and the samples; else all are taken


def vertex_normals(vertices: Tensor, triangles: Tensor) -> Tensor:
    """Unit normals of vertices [..., V, 3], means of the triangles' by area; +z without any area."""
    a, b, c = vertices[..., triangles, :].unbind(-2)
    area_normals = torch.linalg.cross(b - a, c - a).repeat_interleave(3, -2)
    return _unit(torch.zeros_like(vertices).index_add(-2, triangles.reshape(-1), area_normals))


def _unit(vectors: Tensor) -> Tensor:
    """Normalize vectors [..., 3]; zero vectors become +z, without a gradient."""
    length2 = _dot(vectors, vectors)
    zero = (length2 == 0)[..., None]
    length = torch.where(zero, torch.ones_like(length2)[..., None], length2[..., None]).sqrt()
    up = F.pad(zero.to(vectors.dtype), (2, 0))
    return torch.where(zero, up, vectors / length)


def _dot(a: Tensor, b: Tensor) -> Tensor:
    return a[..., 0] * b[..., 0] + a[..., 1] * b[..., 1] + a[..., 2] * b[..., 2]  # sum(-1) is much slower


def smoothstep(x: Tensor) -> Tensor:
    """Smooth step of 0..1, flat at both ends."""
    x = x.clamp(0, 1)
    return x * x * (3 - 2 * x)


def texel_centres_uv(
    side: int, dtype: torch.dtype = torch.float32, device: torch.device | str = "cpu"
) -> Tensor:
    """Return (u, v) of every texel's centre [T, T, 2]."""
    centre = (torch.arange(side, dtype=dtype, device=device) + 0.5) / side
    v, u = torch.meshgrid(centre, centre, indexing="ij")
    return torch.stack([u, v], -1)


def bake_attributes(attributes: Tensor, grid_side: int, texture_side: int) -> Tensor:
    """Interpolate vertex attributes [..., V, C] of a uniform grid to the texels' centres [..., C, T, T]."""
    *batch, count, channels = attributes.shape
    if count != grid_side**2:
        raise ValueError(f"a grid of side {grid_side} has {grid_side**2} vertices, not {count}")
    grid = attributes.mT.reshape(-1, channels, grid_side, grid_side)
    uv = texel_centres_uv(texture_side, attributes.dtype, attributes.device)
    baked = F.grid_sample(grid, (2 * uv - 1).expand(len(grid), -1, -1, -1), align_corners=True)
    return baked.view(*batch, channels, texture_side, texture_side)


def normal_map(vertices_camera: Tensor, triangles: Tensor, texture_side: int) -> Tensor:
    """Return camera-space unit normals [..., 3, T, T] of a uniform grid mesh in UV space."""
    normals = vertex_normals(vertices_camera, triangles)
    baked = bake_attributes(normals, math.isqrt(normals.shape[-2]), texture_side)
    return _unit(baked.movedim(-3, -1)).movedim(-1, -3)


def sample_texture(texture: Tensor, uv: Tensor) -> Tensor:
    """Sample a texture [..., C, T, T] at (u, v) [..., H, W, 2]: [..., H, W, C], clamped at the border."""
    grid = (2 * uv - 1).flatten(0, -4) if uv.dim() > 3 else (2 * uv - 1)[None]
    images = texture.reshape(-1, *texture.shape[-3:]).expand(len(grid), -1, -1, -1)
    found = F.grid_sample(images, grid.to(texture.dtype), padding_mode="border", align_corners=False)
    return found.permute(0, 2, 3, 1).view(*uv.shape[:-1], found.shape[1])


def render_texture(
    texture: Tensor, vertices_camera: Tensor, triangles: Tensor, uv: Tensor, camera: Camera
) -> tuple[Tensor, Tensor]:
    """Render a textured mesh to an image [H, W, C], black outside of it, and a coverage [H, W] of 0 or 1.

    Differentiable in the texture and, through the interpolation, in the vertices.

    Args:
        texture: [C, T, T].
        vertices_camera: [V, 3] in camera space, in metres.
        triangles: [F, 3].
        uv: Of the vertices [V, 2], v down.
        camera: The image's camera.
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
    """Unwrap an image to a uniform grid mesh's texture [..., C, T, T] and its visibility [..., T, T].

    A texel is the weighted mean of up to samples x samples points in it, so that it averages over the pixels
    that it covers. A point's weight is 0 if it is hidden, and falls with the angle between normal and viewing
    ray. The texture is 0 where visibility is 0. Differentiable in the image and the vertices; visibility is
    constant.

    Args:
        image: [..., C, H, W].
        vertices_camera: Of the grid [V, 3] in camera space, in metres.
        triangles: [F, 3].
        camera: The image's camera.
        texture_side: T.
        settings: Samples a texel, and what counts as hidden.
    """
    if image.shape[-2:] != (camera.height_px, camera.width_px):
        raise ValueError(f"image {tuple(image.shape)}: the camera's is {camera.height_px, camera.width_px}")
    samples = settings.samples
    if settings.measured:
        image, camera, samples = _match_scale(image, vertices_camera, camera, texture_side, samples)
    side = math.isqrt(vertices_camera.shape[-2])
    points = bake_attributes(vertices_camera, side, texture_side * samples).movedim(-3, -1)
    with torch.no_grad():
        weight = _visibility(points, vertices_camera, triangles, camera, settings)
    uv = torch.stack(_shares(project(points, camera), camera), -1)
    colour = sample_texture(image, uv).movedim(-1, -3)
    weight = weight.to(image.dtype).unsqueeze(-3)
    visible = F.avg_pool2d(weight, samples)
    texture = F.avg_pool2d(colour * weight, samples) / visible.clamp(min=_TINY)
    return texture, visible.squeeze(-3)


def _shares(px: Tensor, camera: Camera) -> tuple[Tensor, Tensor]:
    """Pixels [..., 2] as shares of the image's width and height."""
    return px[..., 0] / camera.width_px, px[..., 1] / camera.height_px


def _match_scale(
    image: Tensor, vertices_camera: Tensor, camera: Camera, texture_side: int, samples: int
) -> tuple[Tensor, Camera, int]:
    """Scale the image down by a power of two, and choose samples per texel, for about one sample a pixel."""
    side = math.isqrt(vertices_camera.shape[-2])
    px = bake_attributes(project(vertices_camera.detach(), camera), side, texture_side)
    step_px = torch.cat([px.diff(dim=along).norm(dim=-3).flatten() for along in (-2, -1)])
    step = float(step_px.nan_to_num(0, 0).sort().values[int(_STEP_QUANTILE * len(step_px))])
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
    """Return the visibility [..., T, T] in 0..1 of points [..., T, T, 3] of the mesh."""
    normals = normal_map(vertices_camera, triangles, points.shape[-2]).movedim(-3, -1)
    cosine = -_dot(normals, points) / _dot(points, points).sqrt()
    facing = smoothstep((cosine - settings.unseen_cosine) / (settings.seen_cosine - settings.unseen_cosine))
    u, v = _shares(project(points, camera), camera)
    inside = (u >= 0) & (u <= 1) & (v >= 0) & (v <= 1) & (points[..., 2] < 0)
    nearer_m = _in_front_by(points, normals, vertices_camera, triangles, _depth_camera(camera, settings))
    return facing * (inside & (nearer_m < settings.hidden_m))


def _depth_camera(camera: Camera, settings: UnwrapSettings) -> Camera:
    """Return the camera of the depth map: the image's, scaled up to the least size."""
    scale = max(1.0, settings.depth_side_px / max(camera.width_px, camera.height_px))
    width_px, height_px = math.ceil(camera.width_px * scale), math.ceil(camera.height_px * scale)
    return Camera(camera.focal_px * scale, width_px, height_px, camera.cx_px * scale, camera.cy_px * scale)


def _in_front_by(
    points: Tensor, normals: Tensor, vertices_camera: Tensor, triangles: Tensor, camera: Camera
) -> Tensor:
    """Return how many metres the nearest surface is in front of each point [..., T, T]; negative if behind.

    The depth map is exact at pixel centres, so the point is moved to the centre of its pixel along its
    tangent plane; otherwise a slanted surface would hide itself.
    """
    depth_m = rasterize(vertices_camera, triangles, camera).depth_m
    px = project(points, camera).nan_to_num(0, 0, 0)
    column = px[..., 0].floor().long().clamp(0, camera.width_px - 1)
    row = px[..., 1].floor().long().clamp(0, camera.height_px - 1)
    ray = pixel_rays(torch.stack([column, row], -1) + PIXEL_CENTRE, camera)
    toward = _dot(normals, ray).clamp(max=-_TINY)
    plane_depth_m = _dot(normals, points) / toward
    place = (row * camera.width_px + column).flatten(-2)
    return plane_depth_m - depth_m.flatten(-2).gather(-1, place).view_as(plane_depth_m)


def inpaint(texture: Tensor, visible: Tensor) -> Tensor:
    """Fill invisible texels of a texture [..., C, T, T] from the nearest visible ones (push-pull).

    `visible` [..., T, T] in 0..1 is the weight of each texel; fully visible texels stay unchanged.
    """
    filled = _inpaint(texture.reshape(-1, *texture.shape[-3:]), visible.reshape(-1, 1, *visible.shape[-2:]))
    return filled.view_as(texture)


def _inpaint(texture: Tensor, visible: Tensor) -> Tensor:
    if max(visible.shape[-2:]) == 1:
        return texture * (visible > 0)
    weight = F.avg_pool2d(visible, 2, ceil_mode=True, count_include_pad=False)
    coarse = F.avg_pool2d(texture * visible, 2, ceil_mode=True, count_include_pad=False)
    coarse = coarse / weight.clamp(min=_TINY)
    filled = _inpaint(coarse, (4 * weight).clamp(max=1))  # one visible texel of four is enough
    fill = F.interpolate(filled, size=visible.shape[-2:], mode="bilinear", align_corners=False)
    return visible * texture + (1 - visible) * fill


def blurred(maps: Tensor, sigma_px: float) -> Tensor:
    """Blur maps [C, H, W] by a Gaussian; beyond their border they go on as there."""
    return torch.from_numpy(gaussian_filter(maps.numpy(), (0, sigma_px, sigma_px), mode="nearest"))


def blurred_within(maps: Tensor, weight: Tensor, sigma_px: float) -> Tensor:
    """Means of maps [C, H, W] by a Gaussian around each pixel, under weights [H, W]; 0 where these are 0."""
    both = blurred(torch.cat([maps * weight, weight[None]]), sigma_px)
    return both[:-1] / both[-1:].clamp_min(1e-6)
