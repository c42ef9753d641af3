"""Poses of heads of known shape come back from their landmarks, near and far, from a poor first guess."""

import pytest
import torch

from facerf_cli.face.fit_start import pose_from_landmarks
from facerf_cli.face.topology import LANDMARKS_M
from facerf_cli.raster.camera import crop_camera, pose_to_rotation, project

CAMERA = crop_camera(256)
POINTS = torch.from_numpy(LANDMARKS_M[17:])[None]


@pytest.mark.parametrize("pose", [(0, 0, 0), (30, -10, 5), (-40, 15, -20), (10, 20, 170)])
@pytest.mark.parametrize("distance_m", [0.8, 1.3])
def test_the_pose_comes_back(pose, distance_m):
    rotation, translation = (
        pose_to_rotation(*pose).double(),
        torch.tensor([0.02, -0.01, -distance_m]).double(),
    )
    px = project(POINTS @ rotation.T + translation, CAMERA)
    guess = pose_to_rotation(pose[0] + 12, pose[1] - 8, pose[2] + 6).double()[None]
    at = torch.tensor([[0.0, 0.0, -1.0]], dtype=torch.float64)
    found, where = pose_from_landmarks(POINTS, px, CAMERA, guess, at)
    angle_deg = torch.rad2deg(2 * torch.asin((found[0] - rotation).norm() / 8**0.5))
    assert angle_deg < 1.0
    assert (where[0] - translation).abs().max() < 0.02 * distance_m
    seen = project(POINTS @ found.mT + where[:, None], CAMERA)
    assert (seen - px).norm(dim=-1).max() < 1.0


def test_faces_do_not_depend_on_each_other():
    rotation = torch.stack([pose_to_rotation(yaw, 0, 0).double() for yaw in (-30, 0, 25)])
    translation = torch.tensor([[0.0, 0.0, -0.9], [0.03, 0.0, -1.1], [0.0, 0.02, -1.0]], dtype=torch.float64)
    points = POINTS.expand(3, -1, -1)
    px = project(points @ rotation.mT + translation[:, None], CAMERA)
    guess = torch.eye(3, dtype=torch.float64).expand(3, 3, 3)
    whole = pose_from_landmarks(points, px, CAMERA, guess, translation)
    for i in range(3):
        one = pose_from_landmarks(
            *(x[i : i + 1] for x in (points, px)), CAMERA, guess[:1], translation[i : i + 1]
        )
        assert torch.allclose(one[0][0], whole[0][i], atol=1e-9)
