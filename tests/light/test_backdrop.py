"""The background of a map, as a camera that looks down -z sees it."""

from functools import partial

import numpy as np
import torch

from facerf_cli.image.strips import whole
from facerf_cli.light.envmap import backdrop
from facerf_cli.light.sphere import direction_to_uv
from facerf_cli.raster.camera import Camera, pixel_centres_px, pixel_rays, rays_of_rows


def seen(envmap: torch.Tensor, rotate_deg: float = 0.0, blur: float = 0.0) -> np.ndarray:
    camera = Camera(60.0, 60, 40, 30.0, 20.0)
    return whole(backdrop(envmap, (40, 60), partial(rays_of_rows, camera), rotate_deg, blur), 40, 60)


def dot(direction: tuple[float, float, float]) -> torch.Tensor:
    """A dark map with a bright spot."""
    envmap = torch.full((64, 128, 3), 0.1)
    u, v = direction_to_uv(torch.tensor(direction)).tolist()
    envmap[int(v * 64), int(u * 128) % 128] = 50
    return envmap


def brightest(image: np.ndarray) -> tuple[int, int]:
    row, column = np.unravel_index(image.sum(-1).argmax(), image.shape[:2])
    return int(row), int(column)


def test_the_camera_looks_away_from_the_middle_of_the_map() -> None:
    row, column = brightest(seen(dot((0.0, 0.0, -1.0))))
    assert abs(row - 20) <= 3 and abs(column - 30) <= 3


def test_right_is_right_and_up_is_up() -> None:
    assert brightest(seen(dot((0.3, 0.0, -1.0))))[1] > 40
    assert brightest(seen(dot((0.0, 0.2, -1.0))))[0] < 14
    assert seen(dot((0.0, 0.0, 1.0))).max() < 0.2  # behind the camera


def test_a_map_turns_with_its_light() -> None:
    """--rotate adds to every azimuth, where 90 degrees is the picture's right."""
    assert brightest(seen(dot((0.0, 0.0, -1.0)), rotate_deg=-15))[1] > 40


def test_radiance_is_kept_and_blur_spreads_it() -> None:
    np.testing.assert_allclose(seen(torch.full((16, 32, 3), 0.7)), 0.7, rtol=1e-4)
    sharp, soft = seen(dot((0.0, 0.0, -1.0))), seen(dot((0.0, 0.0, -1.0)), blur=0.1)
    assert soft.shape == sharp.shape == (40, 60, 3) and soft.max() < 0.5 * sharp.max()
    np.testing.assert_allclose(soft.mean(), sharp.mean(), rtol=0.25)


def test_rays_of_rows_are_those_of_the_whole_image() -> None:
    camera = Camera(60.0, 60, 40, 30.0, 20.0)
    every = pixel_rays(pixel_centres_px(camera), camera)
    assert torch.equal(rays_of_rows(camera, (40, 60), slice(8, 21)), every[8:21])
    halved = every.view(20, 2, 30, 2, 3).mean((1, 3))  # rays are linear in the pixels
    torch.testing.assert_close(rays_of_rows(camera, (20, 30), slice(0, 20)), halved)


def test_rows_of_a_background_are_those_of_the_whole() -> None:
    camera = Camera(60.0, 60, 40, 30.0, 20.0)
    for blur in (0.0, 0.02, 0.1):
        rows = backdrop(dot((0.0, 0.0, -1.0)), (40, 60), partial(rays_of_rows, camera), blur=blur)
        np.testing.assert_allclose(rows(slice(8, 21)), whole(rows, 40, 60)[8:21], rtol=1e-6)
