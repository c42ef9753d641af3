"""Z-buffer in plain torch: the visible triangle of each pixel, its barycentric weights and its depth.

All triangles are split into pixel rows at once, and all rows into runs of pixels, so the work grows with the
covered area and not with the bounding boxes. Meshes of a batch share these steps. A GPU waits for the host
once for all of them, for the number of rows; runs and pixels have an upper bound there, while the CPU counts
them. A pixel belongs to a triangle if its centre lies inside. A run includes its left end and excludes its
right, a triangle includes its upper end and excludes its lower, and both triangles of a shared edge compute
the same crossing, so each pixel on an edge is covered exactly once. Visibility has no gradient (paper,
'Network Architecture'); the barycentric weights of the visible triangle have one. All arithmetic is
elementwise, so the result does not depend on how triangles are split into parts.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass

import torch
from torch import Tensor

from facerf_cli.raster.camera import PIXEL_CENTRE, Camera, pixel_rays, project

NEAR_M = 0.01  # a triangle is dropped if a corner is nearer than this, or behind the camera
_SLIVER_PX2 = 1e-9  # a projected triangle with less than half this area is degenerate and dropped
_CHUNK_PX = 1 << 24  # bounding-box pixels that are processed together; limits the memory
_SPARE = 1024  # elements for invalid pixels; a GPU would write a single one serially
_FAR_KEY = torch.iinfo(torch.int64).max  # of a pixel without a triangle


@dataclass(frozen=True, eq=False)
class Fragments:
    """Visible point of each pixel of an image, or of the images of a batch."""

    triangle: Tensor  # [..., H, W] int64, -1 for none
    barycentric: Tensor  # [..., H, W, 3] perspective-correct, differentiable in the vertices; 0 for none
    depth_m: Tensor  # [..., H, W] distance along the viewing axis (-z), differentiable; inf for none
    pixel: Tensor  # [P] indices of the covered pixels, or on a GPU of all pixels, in the flat images

    @property
    def covered(self) -> Tensor:
        return self.triangle >= 0


@dataclass(frozen=True, eq=False)
class _Screen:
    """Triangles [N], projected in float64, because float32 is too coarse for slivers."""

    triangle: Tensor  # [N] index in all concatenated meshes
    first_px: Tensor  # [N] index of the first pixel of the triangle's image in the flat images
    corners_px: Tensor  # [N, 3, 2]
    inverse_depth: Tensor  # [N, 3]
    first_row: Tensor  # [N] int64
    rows: Tensor  # [N] int64
    box_px: Tensor  # [N] pixels of the bounding box inside the image

    def part(self, index: Tensor) -> "_Screen":
        return _Screen(*(getattr(self, name)[index] for name in self.__dataclass_fields__))


def rasterize(vertices_camera: Tensor, triangles: Tensor, camera: Camera) -> Fragments:
    """Rasterize vertices [..., V, 3] and triangles [F, 3] of either winding.

    At equal depth the lower index wins. The barycentric weights and the depth are differentiable in the
    vertices; the choice of triangle is not.
    """
    size = (*vertices_camera.shape[:-2], camera.height_px, camera.width_px)
    meshes, vertices = math.prod(size[:-2]), vertices_camera.flatten(0, -2)
    first = torch.arange(meshes, device=triangles.device) * vertices_camera.shape[-2]
    corners = (triangles + first[:, None, None]).flatten(0, 1)  # [M F, 3] of M meshes
    with torch.no_grad():
        triangle = _visible_triangles(vertices.detach(), corners, camera, meshes)
    pixel = _places(triangle >= 0)
    weights, depth = _hit(vertices, corners, triangle[pixel], pixel, camera)
    nothing, far = vertices.new_zeros(len(triangle), 3), vertices.new_full((len(triangle),), torch.inf)
    return Fragments(
        torch.where(triangle < 0, -1, triangle % max(len(triangles), 1)).view(size),
        nothing.index_copy(0, pixel, weights.to(vertices.dtype)).view(*size, 3),
        far.index_copy(0, pixel, depth.to(vertices.dtype)).view(size),
        pixel,
    )


def _places(chosen: Tensor) -> Tensor:
    """Return the indices where a mask [N] is true; on a GPU all, because counting them would wait."""
    if _counts(chosen):
        return torch.nonzero(chosen).squeeze(-1)
    return torch.arange(len(chosen), device=chosen.device)


def _counts(tensor: Tensor) -> bool:
    """Return whether the host knows the sizes of results on the tensor's device without waiting."""
    return tensor.device.type == "cpu"


def interpolate(attributes: Tensor, triangles: Tensor, fragments: Fragments) -> Tensor:
    """Interpolate vertex attributes [V, C] to pixels [..., H, W, C]; pixels without a triangle are zero.

    Differentiable in the attributes and, through the barycentric weights, in the vertices.
    """
    corners = triangles[fragments.triangle.flatten()[fragments.pixel]]  # [P, 3]
    weights = fragments.barycentric.reshape(-1, 3)[fragments.pixel].to(attributes.dtype)
    a, b, c = (weights[:, k, None] * attributes[corners[:, k]] for k in range(3))
    out = attributes.new_zeros(fragments.triangle.numel(), attributes.shape[1])
    return out.index_copy(0, fragments.pixel, a + b + c).view(*fragments.triangle.shape, -1)


def front_facing(vertices_camera: Tensor, triangles: Tensor) -> Tensor:
    """Return whether the counter-clockwise side of each triangle [..., F] of [..., V, 3] faces the camera."""
    a, b, c = vertices_camera[..., triangles, :].unbind(-2)
    return (torch.linalg.cross(b - a, c - a) * a).sum(-1) < 0


def _visible_triangles(vertices_camera: Tensor, triangles: Tensor, camera: Camera, meshes: int) -> Tensor:
    """Return the index of the nearest triangle at each pixel [M * H * W] int64 of M meshes, -1 for none."""
    screen = _on_screen(vertices_camera, triangles, camera, meshes)
    pixels = meshes * camera.height_px * camera.width_px
    nearest = torch.full((pixels + _SPARE,), _FAR_KEY, dtype=torch.int64, device=vertices_camera.device)
    for part, rows, box_px in _chunks(screen):
        owner, pixel = _cover(part, camera.width_px, rows, box_px, pixels)
        depth_bits = _fragment_depth(part, owner, pixel, camera).view(torch.int32)
        # Bits of positive floats sort like the floats, so an integer minimum finds both depth and triangle.
        key = (depth_bits.long() << 32) | part.triangle[owner]
        nearest.scatter_reduce_(0, pixel, key, "amin")
    nearest = nearest[:pixels]
    return torch.where(nearest == _FAR_KEY, -1, nearest & 0xFFFFFFFF)


def _on_screen(vertices_camera: Tensor, triangles: Tensor, camera: Camera, meshes: int) -> _Screen:
    """Project the meshes; triangles that cover no pixel are dropped or, on a GPU, get no rows."""
    vertices = vertices_camera.double()
    px = project(vertices, camera)
    in_front = (vertices[:, 2] < -NEAR_M) & px.isfinite().all(-1)
    corners_px = px[triangles]  # [F, 3, 2]
    ends = (_first_centre(end).unbind(-1) for end in (corners_px.amin(1), corners_px.amax(1)))
    low, high = (
        torch.stack([x.clamp(0, camera.width_px), y.clamp(0, camera.height_px)], -1) for x, y in ends
    )
    a, b, c = corners_px.unbind(1)
    area2_px = (b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0]
    covers = in_front[triangles].all(-1) & (high > low).all(-1) & (area2_px.abs() > _SLIVER_PX2)
    keep = _places(covers)
    first, last = low[keep].long(), high[keep].long()
    size = torch.where(covers[keep, None], last - first, 0)
    inverse_depth = -1 / vertices[:, 2][triangles[keep]]
    first_px = keep * meshes // max(len(triangles), 1) * (camera.width_px * camera.height_px)
    return _Screen(keep, first_px, corners_px[keep], inverse_depth, first[:, 1], size[:, 1], size.prod(-1))


def _first_centre(position_px: Tensor) -> Tensor:
    """Return the index of the first pixel whose centre is at or beyond the position, as a float."""
    return (position_px - PIXEL_CENTRE).ceil()


def _chunks(screen: _Screen) -> Iterator[tuple[_Screen, int, int]]:
    """Split the triangles, in order, into parts of limited bounding-box area; each with its `_totals`."""
    rows, box_px = _totals(screen)
    if box_px <= _CHUNK_PX:
        yield screen, rows, box_px
        return
    number = screen.box_px.cumsum(0) // _CHUNK_PX
    for chunk in range(box_px // _CHUNK_PX + 1):
        part = screen.part(torch.nonzero(number == chunk).squeeze(-1))
        yield part, *_totals(part)


def _totals(screen: _Screen) -> tuple[int, int]:
    """Return the rows and bounding-box pixels of all triangles; a GPU waits here."""
    rows, box_px = torch.stack([screen.rows.sum(), screen.box_px.sum()]).cpu().tolist()
    return rows, box_px


def _cover(screen: _Screen, width_px: int, rows: int, box_px: int, nowhere: int) -> tuple[Tensor, Tensor]:
    """Return all pairs of a triangle and a pixel centre inside it: index into `screen` [P], pixel [P].

    On a GPU, P is the area of the boxes, and pairs beyond the last have pixels from `nowhere` on.
    """
    owner, row = _expand(screen.first_row, screen.rows, rows)
    left, right = _row_crossings(screen.corners_px, owner, row.double() + PIXEL_CENTRE)
    first = _first_centre(left).clamp(0, width_px).long()
    last = _first_centre(right).clamp(0, width_px).long()
    counted = _counts(owner)
    run, column = _expand(first, last - first, int((last - first).sum()) if counted else box_px)
    owner, pixel = owner[run], (screen.first_px[owner] + row * width_px)[run] + column
    return owner, pixel if counted else torch.where(column < last[run], pixel, nowhere + column % _SPARE)


def _expand(first: Tensor, count: Tensor, size: int) -> tuple[Tensor, Tensor]:
    """Expand runs of integers to `size` elements: the run's index, and first + 0, 1, ... count - 1.

    Elements beyond the last run continue it.
    """
    begin = count.cumsum(0) - count
    count = torch.cat([count[:-1], size - begin[-1:]])
    run = torch.repeat_interleave(count, output_size=size)
    return run, torch.arange(size, device=run.device) + (first - begin)[run]


def _row_crossings(corners_px: Tensor, owner: Tensor, y_px: Tensor) -> tuple[Tensor, Tensor]:
    """Return where the line at height `y_px` [R] enters and leaves the triangle `owner` [R]."""
    left = torch.full_like(y_px, torch.inf)
    right = torch.full_like(y_px, -torch.inf)
    for k in range(3):
        start, end = corners_px[:, k], corners_px[:, (k + 1) % 3]
        # Order the ends canonically (top, then left), so that the neighbouring triangle rounds equally.
        swap = (start[:, 1] > end[:, 1]) | ((start[:, 1] == end[:, 1]) & (start[:, 0] > end[:, 0]))
        x0, y0 = torch.where(swap[:, None], end, start).unbind(-1)
        x1, y1 = torch.where(swap[:, None], start, end).unbind(-1)
        slope = (x1 - x0) / (y1 - y0)  # infinite or NaN for a horizontal edge, which no row crosses
        x = x0[owner] + (y_px - y0[owner]) * slope[owner]
        crosses = (y0[owner] <= y_px) & (y_px < y1[owner])
        left = torch.where(crosses, torch.minimum(left, x), left)
        right = torch.where(crosses, torch.maximum(right, x), right)
    return left, right


def _fragment_depth(screen: _Screen, owner: Tensor, pixel: Tensor, camera: Camera) -> Tensor:
    """Return the depth [P] float32 of each pair; 1 / depth is linear in the image."""
    a, b, c = screen.corners_px.unbind(1)
    (abx, aby), (acx, acy) = (b - a).unbind(-1), (c - a).unbind(-1)
    ia, ib, ic = screen.inverse_depth.unbind(-1)
    area2 = abx * acy - aby * acx
    slope_x = ((ib - ia) * acy - (ic - ia) * aby) / area2
    slope_y = ((ic - ia) * abx - (ib - ia) * acx) / area2
    base = ia - slope_x * (a[:, 0] - PIXEL_CENTRE) - slope_y * (a[:, 1] - PIXEL_CENTRE)
    column, row = _column_row(pixel, camera)
    inverse = base[owner] + slope_x[owner] * column + slope_y[owner] * row
    low, high = screen.inverse_depth.amin(-1), screen.inverse_depth.amax(-1)  # slivers round badly
    return (1 / inverse.clamp(low[owner], high[owner])).float()


def _hit(
    vertices_camera: Tensor, triangles: Tensor, visible: Tensor, pixel: Tensor, camera: Camera
) -> tuple[Tensor, Tensor]:
    """Return barycentric weights [P, 3] and depth [P], float64, of triangles `visible` [P] at pixels [P].

    Without a triangle (-1) they are 0 and infinite. For corners a, b, c and weights w: w_a a + w_b b + w_c c
    = depth * ray. By Cramer's rule w_a = depth * ray . (b x c) / (a . (b x c)), and cyclically. Float64,
    because of cancellation.
    """
    corners = vertices_camera.double().nan_to_num()[triangles].permute(1, 2, 0).contiguous()  # [3, xyz, F]
    a, b, c = corners
    cofactors = torch.stack([_cross(b, c), _cross(c, a), _cross(a, b)])  # [3, xyz, F]
    column_row = torch.stack(_column_row(pixel, camera), -1)
    ray = pixel_rays(column_row.double() + PIXEL_CENTRE, camera).T.contiguous()
    hit, visible = visible >= 0, visible.clamp_min(0)  # pixels without a triangle use the first: no NaN
    parts = [_dot(cofactor.index_select(1, visible), ray) for cofactor in cofactors]
    total = torch.where(hit, parts[0] + parts[1] + parts[2], 1)
    volume = _dot(a, cofactors[0])
    weights = torch.stack([torch.where(hit, part / total, 0) for part in parts], -1)
    return weights, torch.where(hit, volume[visible] / total, torch.inf)


def _column_row(pixel: Tensor, camera: Camera) -> tuple[Tensor, Tensor]:
    return pixel % camera.width_px, pixel // camera.width_px % camera.height_px


def _cross(a: Tensor, b: Tensor) -> Tensor:
    """Return the cross product of [3, N]; several times faster than with the axis last."""
    return torch.stack([a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]])


def _dot(a: Tensor, b: Tensor) -> Tensor:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
