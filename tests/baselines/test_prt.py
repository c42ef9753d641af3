"""Transfer that is baked: shadows, poses, and the cache."""

import math

import pytest
import torch
from torch import Tensor

from facerf_cli.baselines.prt import Prt, TransferSettings, bake_transfer
from facerf_cli.face.morphable import load_face_model
from facerf_cli.face.topology import grid_triangles
from facerf_cli.light.sh import cosine_lobe, sh_basis
from facerf_cli.light.sphere import azel_to_direction, rig_directions
from facerf_cli.raster.texture import normal_map

SMALL = TransferSettings(order=4, side=32, lights=80, light_samples=2, bounce_samples=4, blur_texels=0.5)


@pytest.fixture(scope="module")
def vertices() -> Tensor:
    return load_face_model("builtin").mean


@pytest.fixture(scope="module")
def transfer(vertices: Tensor) -> Tensor:
    return bake_transfer(vertices, SMALL)


def white(transfer: Tensor, rotation: Tensor | None = None) -> Prt:
    rotation = torch.eye(3) if rotation is None else rotation
    return Prt(torch.ones(3, 64, 64), transfer[0].expand(3, -1, -1, -1), rotation)


def lit(face: Prt, azimuth_deg: float, elevation_deg: float, turn: Tensor | None = None) -> Tensor:
    light = azel_to_direction(azimuth_deg, elevation_deg)[None]
    return face.relit(light, torch.ones(1, 1, 3), turn)[0, 0]


def test_where_nothing_shadows_it_is_lamberts(vertices: Tensor, transfer: Tensor) -> None:
    """The bridge of the forehead sees all of its hemisphere."""
    normals = normal_map(vertices, grid_triangles(), SMALL.side)
    lobe = torch.cat([torch.full((2 * k + 1,), cosine_lobe(k) / math.pi) for k in range(SMALL.order + 1)])
    wanted = sh_basis(normals.permute(1, 2, 0), SMALL.order) * lobe
    found = transfer[0].permute(1, 2, 0)
    forehead = (slice(2, 5), slice(13, 19))
    assert torch.allclose(found[forehead], wanted[forehead], atol=0.03)


def test_the_nose_shadows_what_is_under_it_and_bounces_add_light(vertices: Tensor, transfer: Tensor) -> None:
    normals = normal_map(vertices, grid_triangles(), SMALL.side)
    lobe = torch.cat([torch.full((2 * k + 1,), cosine_lobe(k) / math.pi) for k in range(SMALL.order + 1)])
    shadowless = (sh_basis(normals.permute(1, 2, 0), SMALL.order) * lobe).permute(2, 0, 1)
    plain = white(shadowless[None])
    share = lit(white(transfer), 0, 70) / lit(plain, 0, 70).clamp_min(0.05)
    assert float(share[:8, 26:38].mean()) > 0.9  # forehead
    assert float(share[38:41, 29:35].mean()) < 0.6  # lip below the nose
    direct, bounce = transfer
    assert float(bounce[0].min()) >= 0
    assert 0.005 < float(bounce[0].mean() / direct[0].mean()) < 0.3


def test_lights_that_turn_with_the_head_change_nothing(transfer: Tensor) -> None:
    c, s = math.cos(0.5), math.sin(0.5)
    turn = torch.tensor([[c, 0, s], [0, 1, 0], [-s, 0, c]])
    face, rig, weights = white(transfer), rig_directions(40), torch.rand(2, 40, 3)
    wanted = face.relit(rig, weights)
    assert torch.allclose(face.relit(rig @ turn.T, weights, turn), wanted, atol=1e-5)
    assert torch.allclose(white(transfer, turn).relit(rig @ turn.T, weights), wanted, atol=1e-5)
    assert not torch.allclose(face.relit(rig, weights, turn), wanted, atol=0.01)
