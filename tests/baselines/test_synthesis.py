"""A scene that the priors made is taken apart again; what a photo's texture adds to it."""

import torch
from torch import Tensor

from facerf_cli.baselines import synthesis
from facerf_cli.baselines.synthesis import (
    SIDE,
    LightPrior,
    LogGaussian,
    Scene,
    scene_of,
    shrunk,
    solve,
    solve_light,
    with_detail,
)
from facerf_cli.face.head import FaceTexture
from facerf_cli.face.topology import region_mask

T, K = 12, 9
TEXELS = 128  # of a photo's texture


def priors() -> tuple[LogGaussian, LogGaussian, LightPrior]:
    albedo = LogGaussian(torch.full((3, T, T), -1.0), 0.3 * torch.randn(4, 3, T, T))
    gloss = LogGaussian(torch.full((1, T, T), -2.0), 0.3 * torch.randn(2, 1, T, T))
    mean = torch.cat([torch.full((1, 3), 3.0), torch.zeros(K - 1, 3)])
    return albedo, gloss, LightPrior(mean, 0.5 * torch.randn(6, K, 3))


def transfers() -> tuple[Tensor, Tensor]:
    """Mostly the constant term, so that light stays positive."""
    both = 0.08 * torch.randn(2, T * T, K)
    both[:, :, 0] = 0.3
    return both[0].expand(3, -1, -1), both[1]


def image(scene: tuple[Tensor, Tensor], albedo: Tensor, gloss: Tensor, light: Tensor) -> Tensor:
    """The forward model, written out: [3, N]."""
    transfer, mirror = scene
    diffuse = albedo.exp().flatten(1) * torch.einsum("cnk,kc->cn", transfer, light)
    return diffuse + gloss.exp().flatten() * (mirror @ light).T


def drawn() -> tuple[tuple[LogGaussian, LogGaussian, LightPrior], tuple[Tensor, Tensor], Tensor]:
    albedo, gloss, light = priors()
    given = transfers()
    coefficients = 5 * (light.mean + torch.einsum("r,rkc->kc", torch.randn(6), light.modes))
    radiance = image(given, albedo.at(torch.randn(4), T), gloss.at(torch.randn(2), T), coefficients)
    return (albedo, gloss, light), given, radiance


def error_of(found: synthesis.Solution, parts: tuple, given: tuple[Tensor, Tensor], truth: Tensor) -> float:
    remade = image(given, parts[0].at(found.albedo, T), parts[1].at(found.gloss, T), found.light)
    return float((remade - truth).norm() / truth.norm())


def test_what_the_priors_made_comes_back_in_spite_of_hair_trust_and_brightness() -> None:
    parts, given, radiance = drawn()
    scene = Scene(radiance, torch.ones(T * T), *given)
    assert error_of(solve(scene, *parts, evidence=1e6, steps=25), parts, given, radiance) < 0.01
    covered = radiance.clone()
    covered[:, : T * T // 8] = 0.01
    found = solve(Scene(covered, torch.ones(T * T), *given), *parts, evidence=1e6, steps=25)
    assert error_of(found, parts, given, radiance) < 0.03
    trust = torch.ones(T * T)
    trust[:20] = 0
    spoilt = radiance.clone()
    spoilt[:, :20] = torch.nan
    found = solve(Scene(spoilt, trust, *given), *parts, evidence=1e6, steps=25)
    assert error_of(found, parts, given, radiance) < 0.01
    once = solve(Scene(radiance, torch.ones(T * T), *given), *parts)
    twice = solve(Scene(2 * radiance, torch.ones(T * T), *given), *parts)
    assert torch.allclose(once.albedo, twice.albedo, atol=1e-4)
    assert torch.allclose(2 * once.light, twice.light, rtol=1e-3, atol=1e-3)
    found = solve(Scene(0 * radiance, torch.ones(T * T), *given), *parts)
    assert not found.light.any() and not found.albedo.any()


def test_the_light_of_a_known_face() -> None:
    parts, given, _ = drawn()
    albedo, gloss = parts[0].at(torch.randn(4), T), parts[1].at(torch.randn(2), T)
    light = 2 * (parts[2].mean + torch.einsum("r,rkc->kc", torch.randn(6), parts[2].modes))
    radiance = image(given, albedo, gloss, light)
    found = solve_light(Scene(radiance, torch.ones(T * T), *given), albedo, gloss, parts[2])
    assert float((found - light).norm() / light.norm()) < 0.02


def test_slopes_are_those_of_the_image() -> None:
    parts, given, radiance = drawn()
    scene = Scene(radiance, torch.ones(T * T), *given)
    seen = scene.trust > 0
    problem = synthesis._problem(scene, seen, 1.0, *parts, evidence=500.0)
    state = 0.3 * torch.randn(1 + 6 + 4 + 2, dtype=torch.float64)
    _, slopes = synthesis._synthesise(problem, state)
    wanted = torch.autograd.functional.jacobian(
        lambda at: synthesis._synthesise(problem, at, False)[0], state
    )
    assert torch.allclose(slopes, wanted.permute(2, 0, 1), atol=1e-9)


def face_of(texture: torch.Tensor, visible: torch.Tensor | None = None) -> FaceTexture:
    normals = torch.zeros(3, TEXELS, TEXELS)
    normals[2] = 1
    return FaceTexture(texture, torch.ones(TEXELS, TEXELS) if visible is None else visible, normals)


def test_unseen_texels_do_not_bleed_into_coarse_ones() -> None:
    texture, visible = torch.full((3, TEXELS, TEXELS), 0.4), torch.ones(TEXELS, TEXELS)
    texture[:, :, 64:] = 9.0
    visible[:, 63:] = 0
    scene = scene_of(face_of(texture, visible), torch.zeros(3, 1, 1), torch.zeros(1, 1))
    trust = scene.trust.view(SIDE, SIDE)
    assert torch.allclose(scene.radiance[:, scene.trust > 0], torch.tensor(0.4))
    assert not trust[:, 32:].any()
    assert float((trust * region_mask("eyes", SIDE)).max()) < 0.3


def test_all_of_the_detail_is_the_true_albedo_where_it_is_bright() -> None:
    true = 0.2 + 0.3 * torch.rand(3, TEXELS, TEXELS)
    shading = torch.full((3, TEXELS, TEXELS), 2.0)
    shading[:, :, :10] = 0.0
    guess = torch.full((3, TEXELS, TEXELS), 0.3).log()
    visible = torch.ones(TEXELS, TEXELS)
    visible[100:] = 0
    face = face_of(true * shading + 0.1, visible)
    shining = torch.full_like(shading, 0.1)
    whole = with_detail(guess, face, shading, shining, 1.0).exp()
    lit = whole[:, :100, 10:]
    assert float((lit - true[:, :100, 10:]).abs().mean()) < 0.2 * float((true - 0.3).abs().mean())
    assert torch.allclose(whole[:, 100:], guess[:, 100:].exp())  # not seen
    assert torch.allclose(whole[:, :100, :10], guess[:, :100, :10].exp(), atol=1e-4)  # black: nothing to see
    half = with_detail(guess, face, shading, shining, 0.5)
    assert torch.allclose(half - guess, 0.5 * (whole.log() - guess), atol=1e-5)


def test_no_albedo_is_above_one_and_a_black_photo_no_trouble() -> None:
    guess = torch.full((3, TEXELS, TEXELS), 0.5).log()
    black = torch.zeros_like(guess)
    found = with_detail(guess, face_of(black + 7), black + 1, black, 1.0)
    assert float(found.max()) <= 0
    assert shrunk(found).shape == (3, SIDE, SIDE)
    guess, black = torch.full((3, TEXELS, TEXELS), 0.5).log(), torch.zeros(3, TEXELS, TEXELS)
    assert with_detail(guess, face_of(black), black, black, 0.5).isfinite().all()
