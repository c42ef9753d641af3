"""Which triangle each pixel sees, where in it, and how far away: a z-buffer in plain torch.

Every triangle is cut into pixel rows and every row into its run of pixels, all of them at once, so the work
grows with what is covered and not with the bounding boxes. A pixel belongs to a triangle if its centre lies
in it; a run holds its left end and not its right, a triangle its upper end and not its lower, and both
triangles of a shared edge compute the same crossing, so that there are neither holes nor doubles. Visibility
has no gradient (paper, 'Network Architecture'); the barycentric weights of the visible triangle have.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import torch
from torch import Tensor

from facerf_cli.raster.camera import PIXEL_CENTRE, Camera, pixel_rays, project

NEAR_M = 0.01  # a triangle with a corner nearer than this, or behind the camera, is dropped whole
_SLIVER_PX2 = 1e-9  # twice the area under which a projected triangle counts as degenerate and is dropped
_CHUNK_PX = 1 << 24  # bounding-box pixels that are worked on at a time; bounds the memory
_FAR_KEY = torch.iinfo(torch.int64).max


@dataclass(frozen=True, eq=False)
class Fragments:
    """What each pixel of a picture sees."""

    triangle: Tensor  # [H, W] int64, -1 where nothing is seen
    barycentric: Tensor  # [H, W, 3] perspective-correct, differentiable in the vertices; 0 where nothing
    depth_m: Tensor  # [H, W] distance along the viewing axis (-z), differentiable; inf where nothing

    @property
    def covered(self) -> Tensor:
        """[H, W] bool: some triangle is seen."""
        return self.triangle >= 0


@dataclass(frozen=True, eq=False)
class _Screen:
    """Triangles [N] that can be seen at all, in float64: a float32 pixel is too coarse for slivers."""

    triangle: Tensor  # [N] id in the mesh
    corners_px: Tensor  # [N, 3, 2]
    inverse_depth: Tensor  # [N, 3]
    first_row: Tensor  # [N] int64
    rows: Tensor  # [N] int64
    box_px: Tensor  # [N] bounding box inside the picture, in pixels

    def part(self, index: Tensor) -> "_Screen":
        return _Screen(*(getattr(self, name)[index] for name in self.__dataclass_fields__))


def rasterize(vertices_camera: Tensor, triangles: Tensor, camera: Camera) -> Fragments:
    """Z-buffer vertices [V, 3] and triangles [F, 3] of either winding; equal depths go to the lower id.

    The barycentric weights and the depth carry gradients to the vertices; which triangle is seen does not.
    """
    with torch.no_grad():
        triangle = _visible_triangles(vertices_camera.detach(), triangles, camera)
    height, width = camera.height_px, camera.width_px
    pixel = torch.nonzero(triangle >= 0).squeeze(-1)
    weights, depth = _hit(vertices_camera, triangles, triangle[pixel], pixel, camera)
    dtype, device = vertices_camera.dtype, vertices_camera.device
    nothing = torch.zeros(height * width, 3, dtype=dtype, device=device)
    far = torch.full((height * width,), torch.inf, dtype=dtype, device=device)
    return Fragments(
        triangle.view(height, width),
        nothing.index_copy(0, pixel, weights.to(dtype)).view(height, width, 3),
        far.index_copy(0, pixel, depth.to(dtype)).view(height, width),
    )


def interpolate(attributes: Tensor, triangles: Tensor, fragments: Fragments) -> Tensor:
    """Vertex attributes [V, C] at every pixel [H, W, C], zero where nothing is seen.

    Differentiable in the attributes and, through the barycentric weights, in the vertices.
    """
    height, width = fragments.triangle.shape
    triangle = fragments.triangle.reshape(-1)
    pixel = torch.nonzero(triangle >= 0).squeeze(-1)
    corners = triangles[triangle[pixel]]  # [P, 3]
    weights = fragments.barycentric.reshape(-1, 3)[pixel].to(attributes.dtype)
    a, b, c = (weights[:, k, None] * attributes[corners[:, k]] for k in range(3))
    values = a + b + c
    out = torch.zeros(height * width, attributes.shape[1], dtype=attributes.dtype, device=attributes.device)
    return out.index_copy(0, pixel, values).view(height, width, -1)


def front_facing(vertices_camera: Tensor, triangles: Tensor) -> Tensor:
    """[F] bool: the triangle's counter-clockwise side looks at the camera."""
    a, b, c = vertices_camera[triangles].unbind(1)
    return (torch.linalg.cross(b - a, c - a) * a).sum(-1) < 0


def _visible_triangles(vertices_camera: Tensor, triangles: Tensor, camera: Camera) -> Tensor:
    """Id of the nearest triangle at each pixel [H * W] int64, -1 where there is none."""
    screen = _on_screen(vertices_camera, triangles, camera)
    pixels = camera.height_px * camera.width_px
    nearest = torch.full((pixels,), _FAR_KEY, dtype=torch.int64, device=vertices_camera.device)
    for part in _chunks(screen):
        owner, pixel = _cover(part, camera.width_px)
        depth_bits = _fragment_depth(part, owner, pixel, camera.width_px).view(torch.int32)
        # The bits of a positive float order like the float, so one integer minimum finds depth and triangle.
        key = (depth_bits.long() << 32) | part.triangle[owner]
        nearest.scatter_reduce_(0, pixel, key, "amin")
    return torch.where(nearest == _FAR_KEY, -1, nearest & 0xFFFFFFFF)


def _on_screen(vertices_camera: Tensor, triangles: Tensor, camera: Camera) -> _Screen:
    vertices = vertices_camera.double()
    px = project(vertices, camera)
    in_front = (vertices[:, 2] < -NEAR_M) & px.isfinite().all(-1)
    corners_px = px[triangles]  # [F, 3, 2]
    limit = torch.tensor([camera.width_px, camera.height_px], dtype=torch.float64, device=px.device)
    low = _first_centre(corners_px.amin(1)).clamp(min=0).minimum(limit)
    high = _first_centre(corners_px.amax(1)).clamp(min=0).minimum(limit)
    a, b, c = corners_px.unbind(1)
    area2_px = (b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0]
    seen = in_front[triangles].all(-1) & (high > low).all(-1) & (area2_px.abs() > _SLIVER_PX2)
    keep = torch.nonzero(seen).squeeze(-1)
    first, last = low[keep].long(), high[keep].long()
    size = last - first
    inverse_depth = -1 / vertices[:, 2][triangles[keep]]
    return _Screen(keep, corners_px[keep], inverse_depth, first[:, 1], size[:, 1], size.prod(-1))


def _first_centre(position_px: Tensor) -> Tensor:
    """Index of the first pixel whose centre is at or beyond the position, as a float."""
    return (position_px - PIXEL_CENTRE).ceil()


def _chunks(screen: _Screen) -> Iterator[_Screen]:
    """The triangles in order, in parts of bounded bounding-box area."""
    if len(screen.triangle) == 0:
        return
    chunk = screen.box_px.cumsum(0) // _CHUNK_PX
    if chunk[-1] == 0:
        yield screen
        return
    for number in torch.unique(chunk):
        yield screen.part(torch.nonzero(chunk == number).squeeze(-1))


def _cover(screen: _Screen, width_px: int) -> tuple[Tensor, Tensor]:
    """Each pair of a triangle and a pixel whose centre it holds: index into `screen` [P], pixel [P]."""
    owner, row = _expand(screen.first_row, screen.rows)
    left, right = _row_crossings(screen.corners_px, owner, row.double() + PIXEL_CENTRE)
    first = _first_centre(left).clamp(0, width_px).long()
    last = _first_centre(right).clamp(0, width_px).long()
    run, column = _expand(first, last - first)
    return owner[run], row[run] * width_px + column


def _expand(first: Tensor, count: Tensor) -> tuple[Tensor, Tensor]:
    """Runs of integers written out: the run's index [sum(count)] and first + 0, 1, ... count - 1."""
    run = torch.repeat_interleave(count)
    begin = count.cumsum(0) - count
    return run, torch.arange(len(run), device=run.device) + (first - begin)[run]


def _row_crossings(corners_px: Tensor, owner: Tensor, y_px: Tensor) -> tuple[Tensor, Tensor]:
    """Left and right end [R] of the part of a triangle that the line y = const runs through."""
    left = torch.full_like(y_px, torch.inf)
    right = torch.full_like(y_px, -torch.inf)
    for k in range(3):
        start, end = corners_px[:, k], corners_px[:, (k + 1) % 3]
        # From the upper end down, and from the left where level: the neighbour then rounds alike.
        swap = (start[:, 1] > end[:, 1]) | ((start[:, 1] == end[:, 1]) & (start[:, 0] > end[:, 0]))
        x0, y0 = torch.where(swap[:, None], end, start).unbind(-1)
        x1, y1 = torch.where(swap[:, None], start, end).unbind(-1)
        slope = (x1 - x0) / (y1 - y0)  # infinite or NaN for a level edge, which no row crosses
        x = x0[owner] + (y_px - y0[owner]) * slope[owner]
        crosses = (y0[owner] <= y_px) & (y_px < y1[owner])
        left = torch.where(crosses, torch.minimum(left, x), left)
        right = torch.where(crosses, torch.maximum(right, x), right)
    return left, right


def _fragment_depth(screen: _Screen, owner: Tensor, pixel: Tensor, width_px: int) -> Tensor:
    """Depth [P] float32 of each pair; 1 / depth is linear on the screen."""
    a, b, c = screen.corners_px.unbind(1)
    (abx, aby), (acx, acy) = (b - a).unbind(-1), (c - a).unbind(-1)
    ia, ib, ic = screen.inverse_depth.unbind(-1)
    area2 = abx * acy - aby * acx
    slope_x = ((ib - ia) * acy - (ic - ia) * aby) / area2
    slope_y = ((ic - ia) * abx - (ib - ia) * acx) / area2
    base = ia - slope_x * (a[:, 0] - PIXEL_CENTRE) - slope_y * (a[:, 1] - PIXEL_CENTRE)
    column, row = pixel % width_px, pixel // width_px
    inverse = base[owner] + slope_x[owner] * column + slope_y[owner] * row
    low, high = screen.inverse_depth.amin(-1), screen.inverse_depth.amax(-1)  # slivers round badly
    return (1 / inverse.clamp(low[owner], high[owner])).float()


def _hit(
    vertices_camera: Tensor, triangles: Tensor, seen: Tensor, pixel: Tensor, camera: Camera
) -> tuple[Tensor, Tensor]:
    """Barycentric weights [P, 3] and depth [P], float64, where pixels [P] see triangles `seen` [P].

    With a, b, c the corners and w the weights, w_a a + w_b b + w_c c = depth * ray; by Cramer's rule
    w_a = depth * ray . (b x c) / (a . (b x c)), and so on round. Float64, since much cancels.
    """
    corners = vertices_camera.double().nan_to_num()[triangles].permute(1, 2, 0).contiguous()  # [3, xyz, F]
    a, b, c = corners
    cofactors = torch.stack([_cross(b, c), _cross(c, a), _cross(a, b)])  # [3, xyz, F]
    column_row = torch.stack([pixel % camera.width_px, pixel // camera.width_px], -1)
    ray = pixel_rays(column_row.double() + PIXEL_CENTRE, camera).T.contiguous()
    parts = [_dot(cofactor.index_select(1, seen), ray) for cofactor in cofactors]
    total = parts[0] + parts[1] + parts[2]
    volume = _dot(a, cofactors[0])
    return torch.stack([part / total for part in parts], -1), volume[seen] / total


def _cross(a: Tensor, b: Tensor) -> Tensor:
    """Cross product of [3, N]; an axis at a time is several times faster than along the last."""
    return torch.stack([a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]])


def _dot(a: Tensor, b: Tensor) -> Tensor:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
