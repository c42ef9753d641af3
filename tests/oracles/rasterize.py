"""A rasterizer that solves for the hit of every pixel's ray with every triangle; slow and obvious."""

import torch
from torch import Tensor

from facerf_cli.raster.camera import Camera


def rasterize_slowly(
    vertices_camera: Tensor, triangles: Tensor, camera: Camera
) -> tuple[Tensor, Tensor, Tensor]:
    """Return triangle [H, W] (-1 = none), barycentric [H, W, 3] and depth [H, W] (inf = none)."""
    triangle = torch.full((camera.height_px, camera.width_px), -1)
    nothing, infinity = torch.zeros(3, dtype=torch.float64), torch.tensor(torch.inf, dtype=torch.float64)
    barycentric = [[nothing] * camera.width_px for _ in range(camera.height_px)]
    depth = [[infinity] * camera.width_px for _ in range(camera.height_px)]
    corners = vertices_camera.double()[triangles].transpose(1, 2)  # [F, 3 (xyz), 3 (corner)]
    for row in range(camera.height_px):
        for column in range(camera.width_px):
            x = (column + 0.5 - camera.cx_px) / camera.focal_px
            y = -(row + 0.5 - camera.cy_px) / camera.focal_px
            ray = torch.tensor([x, y, -1.0], dtype=torch.float64)
            # corners @ w = depth * ray with w summing to one, so solve for w / depth.
            scaled = torch.linalg.solve(corners, ray.expand(len(corners), 3))
            hit = (scaled >= 0).all(-1)
            if hit.any():
                distance = 1 / scaled.sum(-1)
                best = int(torch.where(hit, distance, torch.inf).argmin())
                triangle[row, column] = best
                barycentric[row][column] = scaled[best] * distance[best]
                depth[row][column] = distance[best]
    return triangle, _image(barycentric), _image(depth)


def _image(rows: list[list[Tensor]]) -> Tensor:
    return torch.stack([torch.stack(row) for row in rows])
