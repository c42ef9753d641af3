import math

import pytest
import torch
import torch.nn.functional as F
from torch import Tensor

from facerf_cli.light.sh import irradiance, rig_coefficients, rotated
from facerf_cli.light.sphere import RigLight, rig_directions
from facerf_cli.network.diffuse_sh import DiffuseNetwork, DiffuseSettings, shading
from facerf_cli.network.inputs import MEAN_RADIANCE
from facerf_cli.raster.camera import pose_to_rotation

SETTINGS = DiffuseSettings(16, (4, 8, 8), (4, 8, 8), light_channels=4, light_grid=4, light_hidden=8)


def bump(side: int) -> Tensor:
    """Normals [3, T, T] of something like a face, head frame."""
    axis = torch.linspace(-0.8, 0.8, side)
    y, x = torch.meshgrid(-axis, axis, indexing="ij")
    return F.normalize(torch.stack([x, y - 0.2 * x * y, torch.ones_like(x)]), dim=0)


@pytest.fixture
def network() -> DiffuseNetwork:
    made = DiffuseNetwork(SETTINGS)
    made.set_mean_face(bump(64))
    return made


def faces(count: int, side: int) -> tuple[Tensor, Tensor, Tensor]:
    normals = bump(side).expand(count, 3, -1, -1)
    return torch.rand(count, 3, side, side), normals, torch.ones(count, 1, side, side)


def test_albedo_is_in_bounds_and_what_is_explained_does_not_depend_on_exposure(
    network: DiffuseNetwork,
) -> None:
    texture, normals, visible = faces(2, 24)
    plain, bright = network(texture, normals, visible), network(7 * texture, normals, visible)
    assert [x.shape for x in plain] == [(2, 3, 24, 24), (2, 9, 3), (2, 1, 1, 1)]
    assert plain.albedo.min() > 0 and plain.albedo.max() < 1
    assert torch.allclose(plain.albedo, bright.albedo, atol=1e-5)
    assert torch.allclose(plain.coefficients, bright.coefficients, atol=1e-4)
    assert torch.allclose(7 * plain.exposure, bright.exposure)


def test_untaught_heads_show_an_even_face_as_it_is_in_a_constant_map(network: DiffuseNetwork) -> None:
    for layer in (network.albedo, network.light[-1]):
        torch.nn.init.zeros_(layer.weight)
        torch.nn.init.zeros_(layer.bias)
    _, normals, visible = faces(1, 16)
    albedo, coefficients, exposure = network(torch.full((1, 3, 16, 16), 0.7), normals, visible)
    assert torch.allclose(albedo, torch.full_like(albedo, MEAN_RADIANCE))
    lit = exposure[:, None] * albedo * shading(normals, coefficients[:, None])
    assert torch.allclose(lit, torch.full_like(lit, 0.7), atol=1e-4)


def test_what_is_finer_than_its_side_comes_from_the_texture(network: DiffuseNetwork) -> None:
    texture, normals, visible = faces(1, 32)
    texture[..., ::2] *= 0.5
    albedo = network(texture, normals, visible).albedo
    assert albedo.shape == texture.shape
    assert (albedo[..., 1::2] > albedo[..., ::2]).float().mean() > 0.7


def test_the_light_turns_with_the_head_that_it_was_read_in(network: DiffuseNetwork) -> None:
    """UV space has the light in the head's frame; what leaves the network is in the camera's."""
    turn = pose_to_rotation(35.0, -15.0, 10.0)
    in_head = torch.randn(1, 9, 3)
    normals = torch.einsum("dc,cij->dij", turn, bump(64))[None]
    turned = network._to_camera(in_head, normals)
    assert torch.allclose(turned[0], rotated(in_head[0], turn), atol=1e-4)
    assert torch.allclose(
        shading(normals, turned[:, None]), shading(bump(64)[None], in_head[:, None]), atol=1e-3
    )


def test_shading_is_what_a_white_lambertian_face_shows_one_or_several_at_a_time() -> None:
    """Order 2 has a clamped cosine's ambient and gradient parts right, which is all of a dome."""
    rig = rig_directions(400)
    towards = (1 + rig @ torch.tensor([0.3, 0.4, 0.5])).clamp_min(0)[:, None] * torch.tensor([1.0, 0.5, 0.2])
    coefficients = rig_coefficients(RigLight(rig, towards / len(rig)), 2)
    normals = bump(12)
    cosines = torch.einsum("lc,cij->lij", rig, normals).clamp_min(0)
    true = torch.einsum("lij,lc->cij", cosines, towards / len(rig))
    assert torch.allclose(
        shading(normals[None], coefficients[None, None])[0, 0], true, atol=0.01 * float(true.max())
    )
    normals = torch.stack([bump(6), torch.einsum("dc,cij->dij", pose_to_rotation(40.0, 0.0, 0.0), bump(6))])
    coefficients = torch.randn(2, 3, 9, 3, requires_grad=True)
    lit = shading(normals, coefficients)
    assert lit.shape == (2, 3, 3, 6, 6) and lit.min() == 0
    one = irradiance(normals[1].permute(1, 2, 0), coefficients[1, 2]).clamp_min(0) / math.pi
    assert torch.allclose(lit[1, 2].permute(1, 2, 0), one)
    lit.sum().backward()
    assert coefficients.grad is not None and coefficients.grad.isfinite().all()
