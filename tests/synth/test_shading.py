import math

import torch

from facerf_cli.synth.appearance.skin import draw_skin
from facerf_cli.synth.shading import (
    Skin,
    Strands,
    diffuse_irradiance,
    highlights,
    scatter,
    strand_highlights,
    tilt_normals,
    unit_along,
)


def _skin(side: int = 4, specular: float = 0.04, roughness: float = 0.5) -> Skin:
    def full(channels: int, value: float) -> torch.Tensor:
        return torch.full((1, channels, side, side), value)

    return Skin(full(3, 1.0), full(1, specular), full(1, roughness), full(2, 0.0), torch.ones(1, 3))


def test_a_white_surface_has_radiance_one_and_its_bounce_a_tint() -> None:
    facing = torch.ones(1, 4, 4)
    irradiance = diffuse_irradiance(facing, 0 * facing, facing, torch.ones(3, 4, 4), torch.ones(1, 3))
    assert torch.allclose(irradiance * _skin().albedo[0], torch.ones(3, 4, 4))
    albedo = torch.tensor([0.5, 0.25, 0.125]).view(3, 1, 1).expand(3, 4, 4)
    dark = torch.zeros(1, 4, 4)
    irradiance = diffuse_irradiance(dark, dark + 0.4, dark, albedo, torch.ones(1, 3))
    assert torch.allclose(irradiance[:, 0, 0], torch.tensor([0.2, 0.1, 0.05]))
    normals = unit_along(torch.randn(1, 3, 4, 4), 1)
    assert torch.allclose(
        tilt_normals(normals, normals, normals, torch.zeros(1, 2, 4, 4)), normals, atol=1e-6
    )


def test_scattering_keeps_a_constant_and_the_sum_of_a_point() -> None:
    sigma = torch.tensor([[0.5, 1.0, 2.0]])
    constant = scatter(torch.full((1, 3, 20, 24 - 4), 0.7), sigma)
    assert torch.allclose(constant, torch.full_like(constant, 0.7), atol=1e-6)
    point = torch.zeros(1, 3, 31, 31)
    point[..., 15, 15] = 1
    spread = scatter(point, sigma)
    assert torch.allclose(spread.sum((2, 3)), torch.ones(1, 3), atol=1e-5)
    assert spread[0, 0, 15, 15] > spread[0, 1, 15, 15] > spread[0, 2, 15, 15]


def test_highlights_reflect_less_than_they_receive_and_are_reciprocal() -> None:
    # Directional albedo of the two lobes under a uniform dome: f pi cos over solid angle / pi.
    count = 4000
    index = torch.arange(count) + 0.5
    z = index / count
    turn = math.pi * (1 + 5**0.5) * index
    radius = (1 - z * z).sqrt()
    lights = torch.stack([radius * turn.cos(), radius * turn.sin(), z], -1)[None]
    normals = torch.tensor([0.0, 0, 1]).view(1, 3, 1, 1)
    view = unit_along(torch.tensor([0.5, 0.0, 1.0]), 0).view(1, 3, 1, 1)
    mirror = _skin(1, specular=1.0, roughness=0.4)
    reflected = highlights(normals, view, lights, mirror).sum() * (2 * math.pi / count) / math.pi
    assert 0.6 < reflected < 1.01
    light = unit_along(torch.tensor([0.0, 0.6, 0.8]), 0)
    there = highlights(normals, view, light.view(1, 1, 3), _skin(1))[0, 0, 0, 0] / 0.8
    back = (
        highlights(normals, light.view(1, 3, 1, 1), view.view(1, 1, 3), _skin(1))[0, 0, 0, 0]
        / view[0, 2, 0, 0]
    )
    assert torch.allclose(there, back, rtol=1e-4)


def test_skins_span_light_to_dark_and_repeat_with_their_seed() -> None:
    first, second = (draw_skin(24, 48, torch.Generator().manual_seed(5)) for _ in "ab")
    assert torch.equal(first.albedo, second.albedo)
    cheek = first.albedo[:, :, 24:28, 10:14].mean((1, 2, 3))
    assert cheek.min() < 0.15 and cheek.max() > 0.4
    assert first.albedo.min() > 0 and first.albedo.max() < 1
    assert first.roughness.min() > 0.1 and first.specular.min() >= 0
    red_over_blue = first.albedo[:, 0, 24:28, 10:14].mean((1, 2)) / first.albedo[:, 2, 24:28, 10:14].mean(
        (1, 2)
    )
    assert (red_over_blue > 1).float().mean() > 0.7  # skin is warm; a share wears random colours


def test_hair_glows_against_the_light_and_tints_it() -> None:
    tangents = torch.tensor([[0.0, -1, 0]])
    views = torch.tensor([[0.0, 0, 1]])
    hair = Strands(tangents, views, torch.tensor([0.046]), torch.tensor([0.4]))
    ahead, aside, behind = (
        torch.tensor([[0.0, 0, 1]]),
        torch.tensor([[1.0, 0, 0]]),
        torch.tensor([[0.0, 0, -1]]),
    )
    white, coloured = (
        torch.stack(lobes)
        for lobes in zip(*(strand_highlights(hair, light) for light in (ahead, aside, behind)), strict=True)
    )
    assert white[0] > white[1] > white[2] >= 0
    assert coloured[2] > 10 * coloured[0] and coloured[2] > 10 * coloured[1]
    # TT alone, of light from all around: half of what a strand of width 1 receives, without Fresnel's share.
    turn = torch.linspace(-torch.pi, torch.pi, 721)[:-1]
    around = torch.stack([turn.sin(), 0 * turn, turn.cos()], -1)
    rise = torch.linspace(-1.5, 1.5, 301)
    lights = torch.cat([around * a.cos() + torch.tensor([0.0, 1, 0]) * a.sin() for a in rise])
    area = rise.cos().repeat_interleave(720) * (3 / 300) * (2 * torch.pi / 720)
    _, coloured = strand_highlights(hair, lights)
    assert 0.3 < float((coloured[0] * area).sum()) / torch.pi < 0.6
