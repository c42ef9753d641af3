"""Fields of a baked head for shading: positions, normals, tangents and light transport in UV space.

The shadows of lids and lashes on open eyes are added to the baked visibility here: the face mesh, one smooth
sheet over lids and eyes, does not cast them.
"""

from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor

from facerf_cli.face.topology import GRID, UV_SIZE_MM, grid_triangles
from facerf_cli.raster.texture import bake_attributes, normal_map, texel_centres_uv
from facerf_cli.synth.random_fields import Window, mask

_LIDS_MM, _LASHES_MM = 3.0, 7.0  # distance from the eye
_LASHES_PASS = 0.6  # share of light that passes between them
_GRAZING = 0.15  # least z of a light direction: bounds the length of a shadow


@dataclass(frozen=True)
class HeadFields:
    """One baked head in UV space, head frame; transport is stored in bytes."""

    positions: Tensor  # [3, T, T], m
    normals: Tensor  # [3, T, T]
    tangents: tuple[Tensor, Tensor]  # [3, T, T] each, unit, along u and v
    directions: Tensor  # [L, 3] toward the lights
    visibility: Tensor  # [L, T, T], times 255
    bounce: Tensor  # [L, T, T], square root times 255


def head_fields(head: dict[str, Tensor]) -> HeadFields:
    """Build the fields of one baked head from the tensors of `bake_heads.bake_head`."""
    side = head["visibility"].shape[-1]
    positions = bake_attributes(head["vertices"], GRID, side)
    normals = normal_map(head["vertices"], grid_triangles(), side)
    along_u = F.normalize(_central_difference(positions, -1), dim=0)
    along_v = F.normalize(_central_difference(positions, -2), dim=0)
    lit = head["visibility"] * lid_shadows(head["directions"], side)
    visibility = lit.round().byte()
    return HeadFields(positions, normals, (along_u, along_v), head["directions"], visibility, head["bounce"])


def _central_difference(field: Tensor, dim: int) -> Tensor:
    return torch.gradient(field, dim=dim)[0]


def lid_shadows(directions: Tensor, side: int) -> Tensor:
    """Compute the share of light [L, T, T] that passes lids and lashes, from directions [L, 3], head frame.

    A point of the eye is lit where a ray toward the light leaves through the opening. Elsewhere it is 1.
    """
    opening = mask(Window(side), "eyes", 1.5)  # [1, 1, T, T]
    rows = opening[0, 0].amax(1).nonzero()[:, 0]
    band = slice(int(rows[0]), int(rows[-1]) + 1)  # rows of the eyes
    slope = directions[:, :2] / directions[:, 2:].clamp_min(_GRAZING)  # sideways shift per unit of height
    aside_uv = slope * torch.tensor([1.0, -1.0]) / torch.as_tensor(UV_SIZE_MM, dtype=torch.float32)
    lids, lashes = (_moved(opening, reach_mm * aside_uv, band) for reach_mm in (_LIDS_MM, _LASHES_MM))
    passed = lids * (_LASHES_PASS + (1 - _LASHES_PASS) * lashes)
    through = torch.ones(len(directions), side, side)
    through[:, band] -= opening[0, :, band] * (1 - passed)
    return through


def _moved(field: Tensor, by_uv: Tensor, rows: slice) -> Tensor:
    """Sample rows of a field [1, 1, T, T] at texel centres moved by offsets [L, 2]: [L, R, T]."""
    places = texel_centres_uv(field.shape[-1])[rows] + by_uv[:, None, None]
    return F.grid_sample(field.expand(len(by_uv), -1, -1, -1), 2 * places - 1, align_corners=False)[:, 0]
