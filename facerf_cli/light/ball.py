"""A mirror ball and a diffuse ball under a map, so that one can see which way the map is turned."""

import math
from typing import Literal

import torch
import torch.nn.functional as F
from torch import Tensor

from facerf_cli.light.envmap import texel_integrals
from facerf_cli.light.sphere import direction_to_uv, latlong_directions, latlong_solid_angles

_SAMPLES = 3  # along each side of a pixel
_IRRADIANCE_ROWS, _SOURCE_ROWS = 32, 64  # both far finer than the cosine lobe


def ball(
    envmap: Tensor, side_px: int, kind: Literal["mirror", "diffuse"] = "mirror", rotate_deg: float = 0.0
) -> Tensor:
    """Radiance [side, side, 3] of a ball that fills the square, seen from far along +z; black beyond it.

    Both balls reflect everything, so under a constant map both look like the map. `envmap` [H, W, 3] linear.
    """
    normals, inside = _ball_normals(side_px * _SAMPLES)
    radiance = torch.zeros(*inside.shape, 3)
    if kind == "mirror":
        toward_camera = torch.tensor([0.0, 0, 1])
        reflected = 2 * normals[inside][:, 2:] * normals[inside] - toward_camera
        radiance[inside] = _look_up(_mean_radiance(envmap, 2 * side_px, rotate_deg), reflected)
    else:
        radiance[inside] = _look_up(_irradiance(envmap, rotate_deg) / math.pi, normals[inside])
    return F.avg_pool2d(radiance.permute(2, 0, 1), _SAMPLES).permute(1, 2, 0)


def _ball_normals(side: int) -> tuple[Tensor, Tensor]:
    """Normals [side, side, 3] of the unit ball, and where it is [side, side] bool."""
    x = (torch.arange(side) + 0.5) * (2 / side) - 1
    y, x = torch.meshgrid(-x, x, indexing="ij")
    z2 = 1 - x * x - y * y
    return torch.stack([x, y, z2.clamp(min=0).sqrt()], -1), z2 > 0


def _look_up(latlong: Tensor, directions: Tensor) -> Tensor:
    """A map [H, W, 3] along directions [P, 3], bilinear: [P, 3]."""
    width = latlong.shape[1]
    wrapped = torch.cat([latlong[:, -1:], latlong, latlong[:, :1]], 1).permute(2, 0, 1)[None]
    uv = direction_to_uv(directions)
    x = (uv[:, 0] * width + 1) * (2 / (width + 2)) - 1
    grid = torch.stack([x, 2 * uv[:, 1] - 1], -1)[None, None]
    return F.grid_sample(wrapped, grid, padding_mode="border", align_corners=False)[0, :, 0].T


def _mean_radiance(envmap: Tensor, most_rows: int, rotate_deg: float) -> Tensor:
    """The turned map [h, 2 h, 3], averaged down to `most_rows` so that small pixels do not flicker."""
    height = min(most_rows, len(envmap))
    integrals = texel_integrals(envmap, height, 2 * height, rotate_deg)
    return (integrals / latlong_solid_angles(height, 2 * height, torch.float64)[..., None]).float()


def _irradiance(envmap: Tensor, rotate_deg: float) -> Tensor:
    """Radiance times cosine, integrated, as a small lat-long map of the normals [h, 2 h, 3]."""
    normals = latlong_directions(_IRRADIANCE_ROWS, 2 * _IRRADIANCE_ROWS)
    sources = latlong_directions(_SOURCE_ROWS, 2 * _SOURCE_ROWS).reshape(-1, 3)
    power = texel_integrals(envmap, _SOURCE_ROWS, 2 * _SOURCE_ROWS, rotate_deg).reshape(-1, 3).float()
    return (normals @ sources.T).clamp(min=0) @ power
