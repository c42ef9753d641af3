"""Near lights on a face in UV space, against Lambert's law for each texel."""

from functools import cache

import pytest
import torch
import torch.nn.functional as F
from torch import Tensor

from facerf_cli.face.morphable import load_face_model
from facerf_cli.face.topology import grid_triangles
from facerf_cli.light.entries import StudioLight
from facerf_cli.light.sphere import azel_to_direction
from facerf_cli.light.studio_points import PointLights
from facerf_cli.raster.texture import bake_attributes, normal_map
from facerf_cli.relighting.field import far_lights_of, near_texture

SIDE = 64


@cache
def vertices() -> Tensor:
    return load_face_model("builtin").mean + torch.tensor([0.0, 0.0, -1.0])


class WhiteClay:
    """A white Lambertian face without shadows: a `Reflectance`."""

    def relit(self, directions: Tensor, weights: Tensor, turn: Tensor | None = None) -> Tensor:
        normals = normal_map(vertices(), grid_triangles(), SIDE)
        cosine = torch.einsum("lc,cij->lij", directions, normals).clamp_min(0)
        return torch.einsum("mlc,lij->mcij", weights, cosine)


def positions() -> Tensor:
    return bake_attributes(vertices(), round(len(vertices()) ** 0.5), SIDE)


def points_of(light: StudioLight) -> PointLights:
    return PointLights.of(light, vertices().mean(0))


@pytest.mark.parametrize(
    "light",
    [
        StudioLight(at_m=(0.5, 0.3, 1.0)),
        StudioLight(at_m=(0.4, 0.0, 0.3), size_m=0.4),
        StudioLight(at_m=(0.0, 0.8, 0.8), size_m=0.8),
        StudioLight(at_m=(0.0, 0.0, 0.6), spot_deg=12),
    ],
)
def test_each_texel_sees_the_light_in_its_own_direction_and_distance(light: StudioLight) -> None:
    """Between the grid's directions the cosine is interpolated, which costs up to 2 %."""
    found = near_texture(WhiteClay(), points_of(light), vertices(), SIDE)
    directions, irradiance = points_of(light).arriving(positions())
    normals = normal_map(vertices(), grid_triangles(), SIDE)
    truth = (irradiance * torch.einsum("pijc,cij->pij", directions, normals).clamp_min(0)).sum(0)
    far = WhiteClay().relit(F.normalize(torch.tensor([light.at_m]), dim=1), torch.ones(1, 1, 3))[0, 0]
    assert (found[0] - truth).abs().mean() < 0.02 * truth.mean()
    assert (found[0] - truth).abs().mean() < 0.3 * (far - truth).abs().mean()
    torch.testing.assert_close(found[0], found[2])


def test_a_light_far_away_is_one_far_light() -> None:
    direction = azel_to_direction(40.0, 20.0)
    x, y, z = (3000 * direction).tolist()
    directions, shares = far_lights_of(points_of(StudioLight(at_m=(x, y, z))), positions())
    torch.testing.assert_close(directions, direction[None], atol=1e-5, rtol=0)
    torch.testing.assert_close(shares, torch.ones(1, SIDE, SIDE), atol=1e-3, rtol=0)


@pytest.mark.parametrize("at_m", [(0.5, 0.3, 1.0), (0.16, 0.0, 0.0), (0.0, 0.0, -0.5)])
def test_the_shares_of_the_grid_are_the_irradiance(at_m: tuple[float, float, float]) -> None:
    points = points_of(StudioLight(at_m=at_m, size_m=0.3))
    directions, shares = far_lights_of(points, positions())
    torch.testing.assert_close(shares.sum(0), points.arriving(positions())[1].sum(0), rtol=1e-4, atol=1e-5)
    torch.testing.assert_close(directions.norm(dim=1), torch.ones(len(directions)))
