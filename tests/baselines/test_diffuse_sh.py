from types import SimpleNamespace
from typing import Any

import torch
import torch.nn.functional as F

from facerf_cli.baselines.diffuse_sh import Diffuse, explain_by_diffuse_sh, refitted
from facerf_cli.face.head import FaceTexture
from facerf_cli.light.sphere import azel_to_direction, rig_directions
from facerf_cli.network.diffuse_sh import shading
from facerf_cli.raster.camera import pose_to_rotation
from facerf_cli.relighting.models import SHIPPED_NETWORKS


def ball(side: int = 9) -> torch.Tensor:
    """Normals [3, T, T] that face every way but backwards."""
    axis = torch.linspace(-0.7, 0.7, side)
    y, x = torch.meshgrid(-axis, axis, indexing="ij")
    return F.normalize(torch.stack([x, y, (1 - x**2 - y**2).clamp_min(0.02).sqrt()]), dim=0)


def test_a_light_at_the_right_lights_the_right_also_turned() -> None:
    white = Diffuse(torch.ones(3, 9, 9), ball())
    (lit,) = white.relit(azel_to_direction(90.0, 0.0)[None], torch.ones(1, 1, 3))
    assert lit[:, 4, 8].min() > 3 * lit[:, 4, 0].max()
    assert lit.min() >= 0
    # `turn` is the head's; lights stay with the camera.
    rig, turn = rig_directions(40), pose_to_rotation(30.0, 10.0, -5.0)
    weights = torch.rand(1, 40, 3)
    face = Diffuse(torch.rand(3, 9, 9), ball())
    straight, turned = face.relit(rig, weights), face.relit(rig @ turn.T, weights, turn)
    assert torch.allclose(straight, turned, atol=1e-4)
    assert not torch.allclose(straight, face.relit(rig, weights, turn), atol=1e-2)


def test_a_dome_shows_the_albedo_and_relighting_is_linear_in_it() -> None:
    rig = rig_directions()
    albedo = torch.rand(3, 9, 9)
    dome = (
        4 * torch.ones(2, len(rig), 3) / len(rig)
    )  # a constant map of radiance 1: cells of 4 pi / L over pi
    dome[1] *= 3
    lit = Diffuse(albedo, ball()).relit(rig, dome)
    assert torch.allclose(lit[0], albedo, rtol=0.01)
    assert torch.allclose(lit[1], 3 * lit[0], rtol=1e-4)


def test_the_light_is_solved_for_in_spite_of_what_is_clipped_or_covered() -> None:
    normals, albedo, true = ball(24), 0.1 + 0.3 * torch.rand(3, 24, 24), 0.3 * torch.randn(9, 3)
    true[0] += 4.0
    lit = albedo * shading(normals[None], true[None, None])[0, 0]
    texture = lit.clone()
    texture[:, :5, :6] = 1.0
    visible = torch.ones(24, 24)
    visible[:, -2:] = 0
    texture[:, :, -2:] = 7.0
    start = torch.zeros(9, 3)
    found = refitted(Diffuse(albedo, normals), FaceTexture(texture, visible, normals), start)
    again = albedo * shading(normals[None], found[None, None])[0, 0]
    error = (again - lit).abs()[:, 6:, :-2] / lit[:, 6:, :-2]
    assert error.median() < 0.02
    kept = refitted(Diffuse(albedo, normals), FaceTexture(lit, visible, normals), true)
    assert torch.allclose(kept, true, atol=1e-3)


def test_what_is_shipped_explains_an_evenly_lit_face_by_an_even_light() -> None:
    network = SHIPPED_NETWORKS.diffuse_sh
    skin = torch.tensor([0.45, 0.3, 0.22]).view(3, 1, 1).expand(3, 64, 64)
    normals = F.interpolate(network.mean_normals[None], (64, 64), mode="area")[0]
    models: Any = SimpleNamespace(networks=SHIPPED_NETWORKS)
    texture = FaceTexture(skin, torch.ones(64, 64), F.normalize(normals, dim=0))
    found = explain_by_diffuse_sh(models, None, texture)  # type: ignore[arg-type]
    own = found.reflectance.relit(found.light.directions, found.light.weights[None])[0]
    assert ((own - skin).abs() / skin).mean() < 0.15
    assert 0.15 < found.reflectance.albedo.mean() < 0.5
