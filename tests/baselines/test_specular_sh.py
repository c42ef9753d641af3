"""Diffuse and glossy under spherical harmonics, on a half sphere where everything is known."""

import math

import pytest
import torch
import torch.nn.functional as F
from torch import Tensor

from facerf_cli.baselines import specular_sh
from facerf_cli.baselines.specular_sh import FaceSurface, SpecularSh, diffuse_transfer, mirror_transfer
from facerf_cli.light.sh import irradiance, rig_coefficients
from facerf_cli.light.sphere import RigLight, azel_to_direction, rig_directions

T = 33


def ball(centre_m: float = -1.0, radius_m: float = 0.1) -> FaceSurface:
    """The front of a ball; texels are spread over x and y of its normals."""
    axis = torch.linspace(-0.9, 0.9, T)
    y, x = torch.meshgrid(-axis, axis, indexing="ij")
    normals = F.normalize(torch.stack([x, y, (1 - x * x - y * y).clamp_min(0.01).sqrt()]), dim=0)
    centre = torch.tensor([0.0, 0.0, centre_m])
    return FaceSurface(normals, centre[:, None, None] + radius_m * normals, centre)


def shiny(surface: FaceSurface, albedo: float = 0.4, gloss: float = 0.1) -> SpecularSh:
    return SpecularSh(surface, torch.full((3, T, T), albedo), torch.full((1, T, T), gloss))


def turn_of(yaw_deg: float) -> Tensor:
    c, s = math.cos(math.radians(yaw_deg)), math.sin(math.radians(yaw_deg))
    return torch.tensor([[c, 0, s], [0, 1, 0], [-s, 0, c]])


def test_diffuse_is_irradiance_over_pi_and_light_from_everywhere_mirrored_whole() -> None:
    surface, light = ball(), RigLight(rig_directions(40), torch.rand(40, 3))
    coefficients = rig_coefficients(light, 2)
    found = diffuse_transfer(surface.normals) @ coefficients
    wanted = irradiance(surface.normals.permute(1, 2, 0), coefficients) / math.pi
    assert torch.allclose(found, wanted, atol=1e-5)
    rig = rig_directions(150)
    relit = shiny(ball(), albedo=0.4, gloss=0.1).relit(rig, torch.full((1, 150, 3), 4 / 150))
    assert relit.shape == (1, 3, T, T)
    assert torch.allclose(relit, torch.full_like(relit, 0.5), atol=0.01)
    broad, sharp = specular_sh._blinn_phong(30.0, 8), specular_sh._blinn_phong(1000.0, 8)
    assert broad[0] == pytest.approx(1) and sharp[0] == pytest.approx(1)
    assert all(b < s < 1 for b, s in zip(broad[1:], sharp[1:], strict=True))
    assert list(broad) == sorted(broad, reverse=True)


@pytest.mark.parametrize("azel_deg", [(40.0, 0.0), (-30.0, 50.0), (0.0, 0.0)])
def test_the_highlight_is_where_a_mirror_shows_the_light(azel_deg: tuple[float, float]) -> None:
    surface, light = ball(centre_m=-1000.0), azel_to_direction(*azel_deg)
    relit = shiny(surface, albedo=0.0, gloss=1.0).relit(light[None], torch.ones(1, 1, 3))[0, 0]
    brightest = surface.normals.flatten(1)[:, int(relit.argmax())]
    half = F.normalize(light + torch.tensor([0.0, 0, 1]), dim=0)
    assert float(brightest @ half) > math.cos(math.radians(4))


def test_a_ball_that_turns_looks_as_before_and_mirrors_follow_the_camera() -> None:
    """Its texels turn with it: the one that now shows a normal is another."""
    surface, turn = ball(), turn_of(25)
    rig, weights = rig_directions(60), torch.rand(1, 60, 3)
    turned = shiny(surface).relit(rig, weights, turn)[0]
    normals = torch.einsum("dc,cij->dij", turn, surface.normals)
    positions = surface.centre_m[:, None, None] + 0.1 * normals
    wanted = shiny(FaceSurface(normals, positions, surface.centre_m)).relit(rig, weights)[0]
    assert torch.allclose(turned, wanted, atol=1e-5)
    assert not torch.allclose(turned, shiny(surface).relit(rig, weights)[0], atol=0.01)
    surface = ball(centre_m=-0.3)
    near, far = surface.views(None), ball(centre_m=-1000.0).views(None)
    assert not torch.allclose(near, far, atol=0.05)
    assert torch.allclose(near.norm(dim=0), torch.ones(T, T), atol=1e-5)
    assert mirror_transfer(surface.normals, near).shape == (T, T, (specular_sh.GLOSS_ORDER + 1) ** 2)
