"""The arrow from crop to head: fitted to landmarks, or regressed by the Geometry Network alone."""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import nn

from facerf_cli.errors import UsageError
from facerf_cli.face.crop import from_box, from_landmarks
from facerf_cli.face.fit import fit_landmarks
from facerf_cli.face.topology import LANDMARKS_M
from facerf_cli.files.read import read_image
from facerf_cli.network.geometry import GeometryEstimate, GeometryNetworkSettings
from facerf_cli.portrait.find import find_faces
from facerf_cli.raster.camera import crop_camera, pose_to_rotation, project
from facerf_cli.relighting.fitting import fit_photo, regress_photo
from facerf_cli.relighting.models import SHIPPED_NETWORKS, Models, Sides, load_models
from tests.refusals import refused

SIDES = Sides(64, 128)
PHOTO = np.full((300, 300, 3), 0.2, np.float32)


@pytest.fixture(scope="module")
def models() -> Models:
    return load_models()


@pytest.fixture(scope="module")
def landmarks_px() -> np.ndarray:
    turned = torch.from_numpy(LANDMARKS_M).float() @ pose_to_rotation(20, 5, -4).T
    return project(turned + torch.tensor([0.0, 0.0, -1.2]), crop_camera(300)).double().numpy()


class Unused(nn.Module):
    """A Geometry Network that must not run."""

    def forward(self, crops: torch.Tensor) -> GeometryEstimate:
        raise AssertionError("a fit to landmarks ran the Geometry Network")


def test_a_photo_is_fitted_to_its_landmarks_alone(models: Models, landmarks_px: np.ndarray) -> None:
    found = fit_photo(models.with_networks(geometry=Unused()), PHOTO, landmarks_px, SIDES).fit
    crop = from_landmarks(landmarks_px, SIDES.crop_px)
    alone = fit_landmarks(models.face, crop.to_crop(landmarks_px), crop)
    torch.testing.assert_close(found.vertices_camera(models.face), alone.vertices_camera(models.face))
    assert found.error_iod < 0.02


BOX = (80.0, 70.0, 220.0, 210.0)
ASTRONAUT = Path(__file__).parents[2] / "examples/astronaut.jpg"


class Knows(nn.Module):
    """A Geometry Network that regresses the same head from every crop."""

    def __init__(self, yaw_deg: float) -> None:
        super().__init__()
        self.settings = GeometryNetworkSettings()
        generator = torch.Generator().manual_seed(1)
        alpha, beta = (0.5 * torch.randn(1, count, generator=generator) for count in (5, 3))
        rotation = pose_to_rotation(yaw_deg, 4.0, 2.0)[None]
        self.head = GeometryEstimate(rotation, torch.tensor([[0.01, -0.02, -1.1]]), alpha, beta)

    def forward(self, crops: torch.Tensor) -> GeometryEstimate:
        return self.head


def vertices_of(models: Models, head: GeometryEstimate) -> torch.Tensor:
    """v^c = R (mean + M_id alpha + M_exp beta) + t, by the paper's formula."""
    model = models.face
    shape = model.mean + torch.einsum("k,kvc->vc", head.alpha[0], model.identity[:5])
    shape = shape + torch.einsum("k,kvc->vc", head.beta[0], model.expression[:3])
    return shape @ head.rotation[0].T + head.translation_m[0]


def test_one_forward_pass_gives_the_head(models: Models) -> None:
    network = Knows(15.0)
    head = regress_photo(models.with_networks(geometry=network), PHOTO, BOX, SIDES)
    assert head.fit.crop == from_box(BOX, SIDES.crop_px) and head.cropped.shape == (128, 128, 3)
    wanted = vertices_of(models, network.head)
    torch.testing.assert_close(head.fit.vertices_camera(models.face), wanted)
    landmarks_px = project(models.face.landmarks(wanted[None])[0], head.fit.camera)
    torch.testing.assert_close(head.fit.landmarks_px, landmarks_px)
    assert math.isnan(head.fit.error_iod) and head.fit.quality == "unknown"


def test_the_mean_face_takes_the_regressed_pose(models: Models) -> None:
    network, mean = Knows(15.0), models.face.pose_only()
    own = replace(models.with_networks(geometry=network), face=mean)
    fit = regress_photo(own, PHOTO, BOX, SIDES).fit
    wanted = mean.mean @ network.head.rotation[0].T + network.head.translation_m[0]
    torch.testing.assert_close(fit.vertices_camera(mean), wanted)


def test_heads_of_another_face_model_are_not_regressed(models: Models) -> None:
    other = replace(models.with_networks(geometry=Knows(15.0)), face=replace(models.face, name="other"))
    refused(UsageError, "geometry 'landmarks'", regress_photo, other, PHOTO, BOX, SIDES)


def test_a_box_gives_about_the_crop_of_its_landmarks() -> None:
    photo = read_image(ASTRONAUT).pixels
    whole = find_faces(SHIPPED_NETWORKS.people, photo, "astronaut")[0]
    by_box, by_landmarks = from_box(whole.box_px, 64), from_landmarks(whole.landmarks_px, 64)
    assert by_box.side_px == pytest.approx(by_landmarks.side_px, rel=0.15)
    off_px = [by_box.x0_px - by_landmarks.x0_px, by_box.y0_px - by_landmarks.y0_px]
    assert np.abs(off_px).max() < 0.12 * by_landmarks.side_px
