import math

import pytest
import torch
from torch import Tensor

from facerf_cli.raster.camera import Camera, pose_to_rotation, project
from facerf_cli.raster.rasterize import rasterize
from facerf_cli.raster.texture import (
    UnwrapSettings,
    bake_attributes,
    inpaint,
    normal_map,
    sample_texture,
    unwrap,
    vertex_normals,
)
from tests.refusals import refused
from tests.textured import render_texture

CAMERA = Camera(focal_px=900.0, width_px=300, height_px=220, cx_px=160.0, cy_px=104.0)
SIDE = 65
TILTED = (25.0, 5.0, 3.0)  # yaw, pitch, roll


def grid_uv() -> Tensor:
    step = torch.linspace(0, 1, SIDE)
    v, u = torch.meshgrid(step, step, indexing="ij")
    return torch.stack([u, v], -1).reshape(-1, 2)


def grid_triangles() -> Tensor:
    a = (torch.arange(SIDE - 1)[:, None] * SIDE + torch.arange(SIDE - 1)).reshape(-1)
    b, c, d = a + 1, a + SIDE, a + SIDE + 1
    return torch.cat([torch.stack([a, c, d], -1), torch.stack([a, d, b], -1)])


UV, TRIANGLES = grid_uv(), grid_triangles()


def head(pose: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> Tensor:
    """Half a cylinder with a nose, in front of the camera [V, 3]."""
    azimuth, y = (UV[:, 0] - 0.5) * math.radians(120), (0.5 - UV[:, 1]) * 0.18
    nose = 0.045 * torch.exp(-((azimuth / 0.15) ** 2) - (y / 0.03) ** 2)
    radius = 0.1 + nose
    points = torch.stack([0.8 * radius * azimuth.sin(), y, radius * azimuth.cos()], -1)
    return points @ pose_to_rotation(*pose).T + torch.tensor([0.0, 0, -1])


def smooth_texture(side: int, seed: int = 0) -> Tensor:
    coarse = torch.rand(1, 3, 8, 8, generator=torch.Generator().manual_seed(seed))
    return torch.nn.functional.interpolate(coarse, size=(side, side), mode="bicubic")[0].clamp(0, 1)


def test_normals_of_a_plane_of_a_sphere_and_without_area() -> None:
    plane = torch.cat([UV * torch.tensor([1, -1]), torch.full((len(UV), 1), -2.0)], -1)
    expected = torch.tensor([0.0, 0, 1]).expand(len(UV), 3)
    torch.testing.assert_close(vertex_normals(plane, TRIANGLES), expected)
    azimuth, elevation = (UV[:, 0] - 0.5) * 2, (0.5 - UV[:, 1]) * 2
    ring = elevation.cos()
    sphere = torch.stack([ring * azimuth.sin(), elevation.sin(), ring * azimuth.cos()], -1)
    cosine = (vertex_normals(0.001 * sphere, TRIANGLES) * sphere).sum(-1)
    assert cosine.min() > math.cos(math.radians(1.5))
    baked = normal_map(sphere, TRIANGLES, 32)
    torch.testing.assert_close(baked.norm(dim=0), torch.ones(32, 32))
    vertices = head()
    vertices[: 3 * SIDE] = vertices[0]  # some triangles are points, some vertices see nothing else
    vertices.requires_grad_()
    normals = vertex_normals(vertices, TRIANGLES)
    torch.testing.assert_close(normals.norm(dim=-1), torch.ones(len(vertices)))
    normals[..., 0].sum().backward()
    assert vertices.grad is not None and bool(vertices.grad.isfinite().all())


def test_baking_and_sampling_meet_at_the_texels_centres() -> None:
    baked = bake_attributes(UV, SIDE, 48)
    centre = (torch.arange(48) + 0.5) / 48
    torch.testing.assert_close(baked[0], centre.expand(48, 48), rtol=0, atol=1e-6)
    torch.testing.assert_close(baked[1], centre[:, None].expand(48, 48), rtol=0, atol=1e-6)
    refused(ValueError, "4225 vertices, not 10", bake_attributes, UV[:10], SIDE, 48)
    texture = torch.rand(3, 16, 16)
    centres = bake_attributes(UV, SIDE, 16).permute(1, 2, 0)
    torch.testing.assert_close(sample_texture(texture, centres), texture.permute(1, 2, 0))
    corner = sample_texture(texture, torch.tensor([[[0.0, 0.0], [1.0, 1.0]]]))
    torch.testing.assert_close(corner[0], torch.stack([texture[:, 0, 0], texture[:, -1, -1]]))


def test_a_texture_of_its_own_uv_renders_to_where_it_projects() -> None:
    vertices = head(TILTED)
    side = 256
    image, alpha = render_texture(bake_attributes(UV, SIDE, side), vertices, TRIANGLES, UV, CAMERA)
    assert image.shape == (220, 300, 2) and alpha.shape == (220, 300)
    middle = (SIDE // 3) * SIDE + SIDE // 4
    column, row = project(vertices[middle], CAMERA).long().tolist()
    torch.testing.assert_close(image[row, column], UV[middle], rtol=0, atol=0.02)
    assert image[alpha == 0].abs().max() == 0 and 0.1 < alpha.mean() < 0.9


@pytest.mark.parametrize("scale", [1, 3])
@pytest.mark.parametrize("texture_side", [96, 192])
def test_unwrap_undoes_render(scale: int, texture_side: int) -> None:
    camera = Camera(900.0 * scale, 300 * scale, 220 * scale, 160.0 * scale, 104.0 * scale)
    texture, vertices = smooth_texture(texture_side), head(TILTED)
    image, _ = render_texture(texture, vertices, TRIANGLES, UV, camera)
    found, visible = unwrap(image.permute(2, 0, 1), vertices, TRIANGLES, camera, texture_side)
    assert found.shape == texture.shape and visible.shape == texture.shape[1:]
    seen = visible > 0.9
    seen[[0, 1, -2, -1]] = seen[:, [0, 1, -2, -1]] = False  # these mix with the background
    assert 0.5 < seen.float().mean() < 0.9
    assert (found - texture)[:, seen].abs().mean() < 0.01
    assert (found - texture)[:, seen].abs().quantile(0.99) < 0.05
    assert found[:, visible == 0].abs().max() == 0


def test_a_texel_averages_over_the_pixels_that_it_covers() -> None:
    camera = Camera(8000.0, 2000, 1600, 1000.0, 800.0)
    noise = torch.rand(1, 1600, 2000, generator=torch.Generator().manual_seed(0))
    found, _ = unwrap(noise, head(), TRIANGLES, camera, 64)  # over 20 pixels a texel in each direction
    middle = found[0, 16:48, 16:48]
    assert float(middle.mean()) == pytest.approx(0.5, abs=0.005) and middle.std() < 0.025


def test_texels_behind_the_nose_are_hidden_and_those_before_are_not() -> None:
    vertices = head((25.0, 0, 0))
    _, visible = unwrap(torch.ones(3, 220, 300), vertices, TRIANGLES, CAMERA, 96)
    visible = visible[::2]  # every other row, as `first_hit` is slow
    points = bake_attributes(vertices, SIDE, 96).permute(1, 2, 0)[::2]
    normals = normal_map(vertices, TRIANGLES, 96).permute(1, 2, 0)[::2]
    cosine = -(normals * torch.nn.functional.normalize(points, dim=-1)).sum(-1)
    free = first_hit(vertices, points)
    hidden, seen = visible[~free & (cosine > 0.2)], visible[free & (cosine > 0.4)]
    assert len(hidden) > 25 and len(seen) > 2250
    # Only along the shadow's rim may the mask be off, by a texel.
    assert (hidden > 0.1).float().mean() < 0.1 and (seen < 0.9).float().mean() < 0.01
    assert visible[cosine < 0.1].max() < 0.01


def first_hit(vertices: Tensor, points: Tensor) -> Tensor:
    """Whether nothing lies more than 3 mm before each point [T, T]: every triangle is asked."""
    target = points.reshape(-1, 3).double()
    free = torch.ones(len(target), dtype=torch.bool)
    for to_weights in torch.linalg.inv(vertices.double()[TRIANGLES].transpose(1, 2)).split(256):
        weights = to_weights @ target.T  # of the point, which lies sum(weights) times as far as the triangle
        behind = weights.sum(1) > 1 + 0.003 / target.norm(dim=-1)
        free &= ~((weights >= 0).all(1) & behind).any(0)
    return free.view(points.shape[:2])


def test_texels_outside_the_image_are_invisible_and_a_slanted_plane_is_not() -> None:
    narrow = Camera(900.0, 80, 220, 40.0, 104.0)
    vertices = head()
    _, visible = unwrap(torch.ones(1, 220, 80), vertices, TRIANGLES, narrow, 128)
    x_px = project(bake_attributes(vertices, SIDE, 128).permute(1, 2, 0), narrow)[..., 0]
    assert visible[(x_px < -1) | (x_px > 81)].max() == 0
    assert visible[(x_px > 1) & (x_px < 79)].mean() > 0.9
    _, behind = unwrap(torch.ones(1, 220, 80), vertices + torch.tensor([0.0, 0, 2]), TRIANGLES, narrow, 32)
    assert behind.max() == 0
    flat = torch.cat([(UV - 0.5) * torch.tensor([0.2, -0.2]), torch.zeros(len(UV), 1)], -1)
    small = Camera(90.0, 30, 22, 15.0, 11.0)  # a pixel is 1 cm wide, and 2.7 cm deep on the plane
    plane = flat @ pose_to_rotation(70, 0, 0).T + torch.tensor([0.0, 0, -1])
    _, visible = unwrap(torch.ones(1, 22, 30), plane, TRIANGLES, small, 64, UnwrapSettings(depth_side_px=1))
    assert visible.min() > 0.5
    refused(ValueError, "220, 300", unwrap, torch.ones(3, 300, 220), head(), TRIANGLES, CAMERA, 32)


@pytest.mark.parametrize("side", [64, 75])
def test_inpaint_keeps_the_seen_and_fills_the_rest_from_nearby(side: int) -> None:
    texture = torch.ones(3, side, side)
    texture[0, :, side // 2 :] = 5  # left and right differ in red
    visible = torch.ones(side, side)
    visible[side // 4 : side // 2, 4:20] = 0
    visible[side // 4 : side // 2, -20:-4] = 0
    filled = inpaint(torch.where(visible > 0, texture, 77.0), visible)
    torch.testing.assert_close(filled, texture, rtol=1e-5, atol=1e-5)


def test_inpaint_at_the_extremes() -> None:
    texture, visible = torch.rand(3, 32, 32), torch.zeros(32, 32)
    assert inpaint(texture, visible).abs().max() == 0
    visible[5, 7] = 1
    one = inpaint(texture, visible)
    torch.testing.assert_close(one, texture[:, 5, 7, None, None].expand(3, 32, 32), rtol=1e-5, atol=1e-5)
    torch.testing.assert_close(inpaint(texture, torch.ones(32, 32)), texture)


def test_unwrap_has_gradients_to_image_and_vertices() -> None:
    vertices = head(TILTED).requires_grad_()
    image = smooth_texture(300)[:, :220].clone().requires_grad_()
    found, visible = unwrap(image, vertices, TRIANGLES, CAMERA, 64)
    inpaint(found, visible).sum().backward()
    for leaf in (vertices, image):
        assert leaf.grad is not None and bool(leaf.grad.isfinite().all()) and leaf.grad.abs().max() > 0
    assert not visible.requires_grad and not rasterize(vertices, TRIANGLES, CAMERA).triangle.requires_grad
