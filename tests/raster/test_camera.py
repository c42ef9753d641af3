import math

import pytest
import torch

from facerf_cli.raster.camera import (
    Camera,
    crop_camera,
    pose_to_rotation,
    project,
    rays_of_rows,
    rotation_to_pose,
    so3_exp,
)

NOSE = torch.tensor([0.0, 0.0, 1.0])


def test_the_crop_camera_is_the_one_of_every_checkpoint_and_projects_by_hand() -> None:
    """Focal length four sides, centred: networks and fits are useless in another one."""
    assert crop_camera(100) == Camera(400.0, 100, 100, 50.0, 50.0)
    point = torch.tensor([0.05, -0.03, -1.1])
    torch.testing.assert_close(project(point, crop_camera(512)), 2 * project(point, crop_camera(256)))
    camera = Camera(focal_px=100, width_px=40, height_px=20, cx_px=21, cy_px=9)
    px = project(torch.tensor([[0.0, 0, -1], [0.1, 0, -1], [0, 0.1, -2]]), camera)
    torch.testing.assert_close(px, torch.tensor([[21.0, 9], [31, 9], [21, 4]]))


def test_rays_of_an_image_at_twice_the_size_pass_through_its_pixel_centres() -> None:
    camera = Camera(50, 7, 4, 3, 2)
    px = project(rays_of_rows(camera, (8, 14), slice(2, 5)), camera)
    assert px.shape == (3, 14, 2)
    torch.testing.assert_close(px[0, 0], torch.tensor([0.25, 1.25]))
    torch.testing.assert_close(px[2, 13], torch.tensor([6.75, 2.25]))


def test_pose_signs() -> None:
    assert (pose_to_rotation(30, 0, 0) @ NOSE)[0] > 0.4  # to the image's right
    assert (pose_to_rotation(0, 30, 0) @ NOSE)[1] < -0.4  # down
    up = pose_to_rotation(0, 0, 30) @ torch.tensor([0.0, 1, 0])
    assert up[0] < -0.4  # counter-clockwise: the crown goes to the image's left


POSES = [(0, 0, 0), (10, 20, 30), (-170, 60, 5), (45, -89, -170), (30, 90, 0), (30, -90, 0)]


@pytest.mark.parametrize("pose", POSES)
def test_pose_round_trip(pose: tuple[float, float, float]) -> None:
    rotation = pose_to_rotation(*pose)
    torch.testing.assert_close(rotation @ rotation.T, torch.eye(3), atol=1e-6, rtol=0)
    assert rotation_to_pose(rotation) == pytest.approx(pose, abs=1e-3)


def test_so3_exp_is_the_matrix_exponential() -> None:
    x, y, z = omega = torch.tensor([0.3, -1.2, 2.0], dtype=torch.float64)
    skew = torch.tensor([[0, -z, y], [z, 0, -x], [-y, x, 0]], dtype=torch.float64)
    torch.testing.assert_close(so3_exp(omega), torch.matrix_exp(skew))
    yaw = so3_exp(torch.tensor([0.0, math.radians(30), 0]))
    torch.testing.assert_close(yaw, pose_to_rotation(30, 0, 0))


@pytest.mark.parametrize("size", [0.0, 1e-9, 0.0099, 0.0101, 1.0, 3.1])
def test_so3_exp_has_the_right_gradient_from_zero_to_pi(size: float) -> None:
    omega = (size * torch.tensor([[0.6, 0.0, -0.8]], dtype=torch.float64)).requires_grad_()
    assert torch.autograd.gradcheck(so3_exp, omega)
    assert torch.autograd.gradcheck(so3_exp, omega.detach().expand(2, 3).clone().requires_grad_())
