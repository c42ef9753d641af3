"""The arrow from crop to fit, with and without a Geometry Network."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from facerf_cli.face.crop import from_landmarks
from facerf_cli.face.topology import LANDMARKS_M
from facerf_cli.models import Models, load_models
from facerf_cli.network.geometry import GeometryNetwork, GeometryNetworkSettings
from facerf_cli.pipeline import fit_photo, regress_head
from facerf_cli.raster.camera import crop_camera, pose_to_rotation, project

PHOTO = np.full((300, 300, 3), 0.2, np.float32)


@pytest.fixture(scope="module")
def models() -> Models:
    return load_models(None, "builtin", torch.device("cpu"))


@pytest.fixture(scope="module")
def landmarks_px() -> np.ndarray:
    turned = torch.from_numpy(LANDMARKS_M).float() @ pose_to_rotation(20, 5, -4).T
    return project(turned + torch.tensor([0.0, 0.0, -1.2]), crop_camera(300)).double().numpy()


def test_without_the_network_the_fit_starts_from_the_landmarks(models: Models) -> None:
    assert regress_head(replace(models, geometry=None), PHOTO) is None


def test_the_networks_start_leads_to_the_same_fit(models: Models, landmarks_px: np.ndarray) -> None:
    torch.manual_seed(0)
    seeing = replace(
        models, geometry=GeometryNetwork(GeometryNetworkSettings(identity=3, expression=2)).eval()
    )
    start = regress_head(seeing, from_landmarks(landmarks_px, 128).apply(PHOTO))
    assert start and start.rotation.shape == (1, 3, 3) and start.alpha.shape == (1, 3)
    cold = fit_photo(replace(models, geometry=None), PHOTO, landmarks_px, 64).fit
    warm = fit_photo(seeing, PHOTO, landmarks_px, 64).fit
    assert warm.error_iod == pytest.approx(cold.error_iod, abs=5e-4)
    moved_m = warm.vertices_camera(models.face) - cold.vertices_camera(models.face)
    assert moved_m.norm(dim=-1).max() < 2e-3


def test_the_default_network_on_a_blank_photo_does_not_spoil_the_fit(
    models: Models, landmarks_px: np.ndarray
) -> None:
    assert fit_photo(models, PHOTO, landmarks_px, 64).fit.error_iod < 0.02
