"""Textures in UV space: sample, unwrap from an image, inpaint, and bake normals.

A mesh here is a uniform grid in UV: vertex (row i, column j) of a side x side grid is at (j, i) / (side - 1).
Meshes, images and textures may be batches. Textures are [C, T, T]; u runs right, v down, and the centre of
texel (row i, column j) is at ((j + 0.5) / T, (i + 0.5) / T).
"""

import math
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from scipy.ndimage import gaussian_filter
from torch import Tensor

from facerf_cli.raster.camera import PIXEL_CENTRE, Camera, pixel_rays, project
from facerf_cli.raster.rasterize import rasterize

_TINY = 1e-12  # avoids division by 0
_STEP_QUANTILE = 0.95  # of the distance between texels in an image, which determines its scale


@dataclass(frozen=True)
class UnwrapSettings:
    """Conditions for a texel to count as visible."""

    hidden_m: float = 0.0025  # a texel is hidden if a surface is this far in front of it
    unseen_cosine: float = 0.12  # of normal and viewing ray: invisible up to this,
    seen_cosine: float = 0.35  # fully visible from this, smooth in between
    depth_side_px: int = 512  # least length of the depth map's longer side
    samples: int = 4  # at most samples x samples per texel; a larger image is scaled down first
    measured: bool = True  # choose the image's scale and the samples by the texels' sizes


def vertex_normals(vertices: Tensor, triangles: Tensor) -> Tensor:
    """Return unit normals of vertices [..., V, 3], weighted by the triangles' area; +z without any area."""
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
    """Return the smooth step of 0..1, flat at both ends."""
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
    sampled = F.grid_sample(images, grid.to(texture.dtype), padding_mode="border", align_corners=False)
    return sampled.permute(0, 2, 3, 1).view(*uv.shape[:-1], sampled.shape[1])


def unwrap(
    image: Tensor,
    vertices_camera: Tensor,
    triangles: Tensor,
    camera: Camera,
    texture_side: int,
    settings: UnwrapSettings = UnwrapSettings(),
    weight: Tensor | None = None,
) -> tuple[Tensor, Tensor]:
    """Unwrap an image to a uniform grid mesh's texture [..., C, T, T] and its visibility [..., T, T].

    A texel is the weighted mean of up to samples x samples points in it, so that it averages over the pixels
    that it covers. A point's weight is 0 if it is hidden, and falls with the angle between normal and viewing
    ray. The texture is 0 where visibility is 0. Differentiable in the image and the vertices; visibility is
    constant.

    Args:
        image: [..., C, H, W].
        vertices_camera: Vertices of the grid [V, 3] in camera space, in metres.
        triangles: [F, 3].
        camera: The image's camera.
        texture_side: T.
        settings: Samples per texel and limits of visibility.
        weight: `point_weights` of the mesh, if they are known already; only for settings that are not
            `measured`.
    """
    if image.shape[-2:] != (camera.height_px, camera.width_px):
        raise ValueError(
            f"image {tuple(image.shape)}, but the camera has {camera.height_px, camera.width_px}"
        )
    samples = settings.samples
    if settings.measured:
        image, camera, samples = _match_scale(image, vertices_camera, camera, texture_side, samples)
    points = _points(vertices_camera, texture_side * samples)
    if weight is None:
        with torch.no_grad():
            weight = _visibility(points, vertices_camera, triangles, camera, settings)
    uv = torch.stack(_shares(project(points, camera), camera), -1)
    colour = sample_texture(image, uv).movedim(-1, -3)
    weight = weight.to(image.dtype).unsqueeze(-3)
    visible = F.avg_pool2d(weight, samples)
    texture = F.avg_pool2d(colour * weight, samples) / visible.clamp(min=_TINY)
    return texture, visible.squeeze(-3)


@torch.no_grad()
def point_weights(
    vertices_camera: Tensor, triangles: Tensor, camera: Camera, texture_side: int, settings: UnwrapSettings
) -> Tensor:
    """Return the weights [..., T samples, T samples] of the points that `unwrap` averages."""
    points = _points(vertices_camera, texture_side * settings.samples)
    return _visibility(points, vertices_camera, triangles, camera, settings)


def _points(vertices_camera: Tensor, side: int) -> Tensor:
    return bake_attributes(vertices_camera, math.isqrt(vertices_camera.shape[-2]), side).movedim(-3, -1)


def _shares(px: Tensor, camera: Camera) -> tuple[Tensor, Tensor]:
    return px[..., 0] / camera.width_px, px[..., 1] / camera.height_px


def _match_scale(
    image: Tensor, vertices_camera: Tensor, camera: Camera, texture_side: int, samples: int
) -> tuple[Tensor, Camera, int]:
    """Scale the image down by a power of two and choose samples per texel, for about one sample per pixel."""
    side = math.isqrt(vertices_camera.shape[-2])
    px = bake_attributes(project(vertices_camera.detach(), camera), side, texture_side)
    step_px = torch.cat([px.diff(dim=along).norm(dim=-3).flatten() for along in (-2, -1)])
    step = float(step_px.nan_to_num(0, 0).sort().values[int(_STEP_QUANTILE * len(step_px))])
    shrink = 2 ** max(0, math.ceil(math.log2(max(step, 1) / samples)))
    if shrink > 1:
        camera = camera.scaled(1 / shrink)
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
    depth_scale = max(1.0, settings.depth_side_px / max(camera.width_px, camera.height_px))
    nearer_m = _in_front_by(points, normals, vertices_camera, triangles, camera.scaled(depth_scale))
    return facing * (inside & (nearer_m < settings.hidden_m))


def _in_front_by(
    points: Tensor, normals: Tensor, vertices_camera: Tensor, triangles: Tensor, camera: Camera
) -> Tensor:
    """Return the distance in metres of the nearest surface in front of each point [..., T, T].

    Points in front of the surface have negative values. The depth map is exact at pixel centres, so the point
    is moved to the centre of its pixel along its tangent plane; otherwise a slanted surface would hide
    itself.
    """
    depth_m = rasterize(vertices_camera, triangles, camera).depth_m
    px = project(points, camera).nan_to_num(0, 0, 0)
    column = px[..., 0].floor().long().clamp(0, camera.width_px - 1)
    row = px[..., 1].floor().long().clamp(0, camera.height_px - 1)
    ray = pixel_rays(torch.stack([column, row], -1) + PIXEL_CENTRE, camera)
    toward = _dot(normals, ray).clamp(max=-_TINY)
    plane_depth_m = _dot(normals, points) / toward
    pixel = (row * camera.width_px + column).flatten(-2)
    return plane_depth_m - depth_m.flatten(-2).gather(-1, pixel).view_as(plane_depth_m)


def inpaint(texture: Tensor, visible: Tensor) -> Tensor:
    """Fill invisible texels of a texture [..., C, T, T] from the nearest visible ones (push-pull).

    `visible` [..., T, T] in 0..1 is the weight of each texel; fully visible texels stay unchanged.
    """
    return Inpainting(visible)(texture)


class Inpainting:
    """`inpaint` of several textures with the same visibility [..., T, T]."""

    def __init__(self, visible: Tensor) -> None:
        self._levels = list[tuple[Tensor, Tensor]]()  # visibility, and its sums over 2 x 2 texels
        visible = visible.reshape(-1, 1, *visible.shape[-2:])
        while max(visible.shape[-2:]) > 1:
            total = _sums_of_four(visible)
            self._levels.append((visible, total.clamp(min=_TINY)))
            count = _sums_of_four(torch.ones_like(visible))
            visible = (4 / count * total).clamp(max=1)  # one visible texel of four is enough
        self._any = visible > 0

    def __call__(self, texture: Tensor) -> Tensor:
        """Fill a texture [..., C, T, T]."""
        coarser = [texture.reshape(-1, *texture.shape[-3:])]
        for visible, total in self._levels:
            coarser.append(_sums_of_four(coarser[-1] * visible) / total)
        filled = coarser.pop() * self._any
        for (visible, _), seen in zip(reversed(self._levels), reversed(coarser), strict=True):
            fill = F.interpolate(filled, size=visible.shape[-2:], mode="bilinear", align_corners=False)
            filled = torch.lerp(fill, seen, visible)
        return filled.view_as(texture)


def _sums_of_four(maps: Tensor) -> Tensor:
    """Return sums [..., h / 2, w / 2] over 2 x 2 texels, rounded up; twice as fast as `avg_pool2d`."""
    if maps.shape[-2] % 2 or maps.shape[-1] % 2:
        maps = F.pad(maps, (0, maps.shape[-1] % 2, 0, maps.shape[-2] % 2))
    rows = maps[..., ::2, :] + maps[..., 1::2, :]
    return rows[..., ::2] + rows[..., 1::2]


def blurred(maps: Tensor, sigma_px: float) -> Tensor:
    """Blur maps [C, H, W] by a Gaussian; their borders are repeated."""
    return torch.from_numpy(gaussian_filter(maps.numpy(), (0, sigma_px, sigma_px), mode="nearest"))


def blurred_within(maps: Tensor, weight: Tensor, sigma_px: float) -> Tensor:
    """Average maps [C, H, W] by a Gaussian with weights [H, W]; 0 where these are 0."""
    both = blurred(torch.cat([maps * weight, weight[None]]), sigma_px)
    return both[:-1] / both[-1:].clamp_min(1e-6)


@dataclass(frozen=True, eq=False)
class Pixels:
    """Some pixels of maps [..., S, S]; their values are maps of one row, [..., 1, N]."""

    numbers: Tensor  # [N], row by row
    side: int

    @staticmethod
    def of(chosen: Tensor) -> "Pixels":
        """Choose pixels by a mask [S, S]."""
        return Pixels(chosen.flatten().nonzero()[:, 0], chosen.shape[-1])

    def values(self, maps: Tensor) -> Tensor:
        """Return the values [..., 1, N] of maps [..., S, S]."""
        return maps.flatten(-2).index_select(-1, self.numbers)[..., None, :]

    def maps(self, values: Tensor) -> Tensor:
        """Return maps [..., S, S] of values [..., 1, N], 0 at other pixels."""
        maps = values.new_zeros(*values.shape[:-2], self.side, self.side)
        maps.flatten(-2).index_copy_(-1, self.numbers, values[..., 0, :])
        return maps
