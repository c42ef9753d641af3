"""Textures of a face under near lights, by any model that relights it under far ones.

Seen from the face, a near light covers a patch of directions: each texel sees its points elsewhere. A grid of
far lights spans the patch, and each texel mixes them bilinearly, by where it sees the light and how near.
Between the grid's directions that is an approximation; a light at a great distance is a far one exactly.
"""

import math

import torch
import torch.nn.functional as F
from torch import Tensor

from facerf_cli.baselines.base import Reflectance
from facerf_cli.light.studio_points import PointLights
from facerf_cli.raster.texture import bake_attributes

_APART_DEG, _MOST_STEPS = 10.0, 3  # of the grid, and steps from its middle; wider patches have wider steps
_POINT_DEG = 0.5  # half a patch's width up to which a light is far
_SIDE = 64  # texels of the maps by which far lights are mixed: they are smooth
_AT_ONCE = 8  # far lights


def near_texture(
    reflectance: Reflectance, points: PointLights, vertices_m: Tensor, side: int, turn: Tensor | None = None
) -> Tensor:
    """The texture [3, side, side] of a face, vertices [V, 3] in camera space, under a near light of rgb 1.

    `turn` is that of `Reflectance.relit`; the vertices are turned already.
    """
    positions_m = bake_attributes(vertices_m, math.isqrt(len(vertices_m)), _SIDE)
    directions, shares = far_lights_of(points, positions_m)
    total = torch.zeros(3, side, side)
    for some, maps in zip(torch.split(directions, _AT_ONCE), torch.split(shares, _AT_ONCE), strict=True):
        each = torch.eye(len(some))[..., None].expand(-1, -1, 3)
        textures = reflectance.relit(some, each, turn)
        wide = F.interpolate(maps[:, None], size=(side, side), mode="bilinear", align_corners=False)
        total = total + (wide * textures).sum(0)
    return total


def far_lights_of(points: PointLights, positions_m: Tensor) -> tuple[Tensor, Tensor]:
    """Directions [K, 3] of far lights that span a near one, and the share [K, T, T] of each at positions.

    positions [3, T, T] are in camera space. The grid is one of angles about the direction to the light's
    middle (azimuthal equidistant), so that it can span more than a half-space.
    """
    toward, irradiance = points.arriving(positions_m)  # [P, T, T, 3], [P, T, T]
    axis = -points.toward
    sides = _sides(axis)
    away = torch.stack([(toward * side).sum(-1) for side in sides], -1)
    angle = torch.atan2(away.norm(dim=-1), (toward * axis).sum(-1))
    flat_deg = torch.rad2deg(angle / away.norm(dim=-1).clamp_min(1e-9))[..., None] * away  # [P, T, T, 2]
    extent_deg = float(flat_deg.abs().max())
    steps = 0 if extent_deg < _POINT_DEG else min(math.ceil(extent_deg / _APART_DEG), _MOST_STEPS)
    apart_deg = max(_APART_DEG, extent_deg / max(steps, 1))
    cells = (flat_deg / apart_deg).clamp(-steps, steps)
    across, along = (_hats(cells[..., number], steps) for number in (0, 1))
    shares = torch.einsum("pij,puij,pvij->uvij", irradiance, across, along)
    offsets = torch.arange(-steps, steps + 1) * math.radians(apart_deg)
    directions = _directions(offsets, axis, sides)
    used = shares.amax((2, 3)) > 0
    return directions[used], shares[used]


def _hats(places: Tensor, steps: int) -> Tensor:
    """Linear shares [P, 2 steps + 1, T, T] of places [P, T, T] in -steps..steps among whole numbers."""
    nodes = torch.arange(-steps, steps + 1)[:, None, None]
    return (1 - (places[:, None] - nodes).abs()).clamp_min(0)


def _directions(offsets: Tensor, axis: Tensor, sides: tuple[Tensor, Tensor]) -> Tensor:
    """Unit directions [n, n, 3] at angles [n] from an axis toward each of two sides."""
    u, v = torch.meshgrid(offsets, offsets, indexing="ij")
    angle = torch.hypot(u, v)[..., None]
    slope = torch.sinc(angle / math.pi)  # sin(angle) / angle
    return angle.cos() * axis + slope * (u[..., None] * sides[0] + v[..., None] * sides[1])


def _sides(axis: Tensor) -> tuple[Tensor, Tensor]:
    """Two unit vectors that are orthogonal to an axis [3] and to each other."""
    helper = torch.eye(3)[int(axis.abs().argmin())]
    first = F.normalize(torch.linalg.cross(axis, helper), dim=0)
    return first, torch.linalg.cross(axis, first)
