"""One head from several calibrated cameras: closer to the truth than any single fit, and seen by all."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor

from facerf_cli.errors import InputError
from facerf_cli.face.crop import from_landmarks
from facerf_cli.face.fit import IOD_M, Heads, fit_in_crop, fit_landmarks, fit_views
from facerf_cli.face.morphable import MorphableModel, load_face_model
from facerf_cli.raster.camera import PosedCamera, pose_to_rotation, project
from tests.refusals import refused

YAWS_DEG = (-45.0, -15.0, 15.0, 40.0)
HEAD_WORLD = (0.3, 1.2, -0.4)  # the world is not the head's


@pytest.fixture(scope="module")
def model() -> MorphableModel:
    return load_face_model()


def camera_at(yaw_deg: float, distance_m: float = 1.1, side_px: int = 400) -> PosedCamera:
    """A camera that sees the head turned by a yaw, slightly off the centre of its image."""
    rotation = pose_to_rotation(yaw_deg, 4.0, 2.0).double()
    centre = torch.tensor([0.01, -0.02, -distance_m], dtype=torch.float64)
    head = torch.tensor(HEAD_WORLD, dtype=torch.float64)
    focal_px = 3.4 * side_px * distance_m
    return PosedCamera(
        (focal_px, 1.001 * focal_px),
        (side_px / 2 + 3, side_px / 2 - 5),
        side_px,
        side_px,
        rotation,
        centre - rotation @ head,
    )


CAMERAS = [camera_at(yaw_deg) for yaw_deg in YAWS_DEG]


def true_head(model: MorphableModel, seed: int, scale: float = 1.0) -> tuple[Tensor, Tensor]:
    """The vertices of someone [V, 3] in the head frame and in the world, float64."""
    generator = torch.Generator().manual_seed(seed)
    alpha = scale * torch.randn(1, len(model.identity), generator=generator)
    beta = 0.3 * torch.randn(1, len(model.expression), generator=generator)
    head = model.vertices(alpha, beta)[0].double()
    return head, head + torch.tensor(HEAD_WORLD, dtype=torch.float64)


def seen(
    model: MorphableModel, world: Tensor, camera: PosedCamera, noise_iod: float, seed: int
) -> np.ndarray:
    """Landmarks [68, 2] with a detector's noise."""
    noise = np.random.default_rng(seed).normal(0, noise_iod, (68, 2))
    exact = camera.project(model.landmarks(world[None])[0]).numpy()
    return exact + noise * iod_px(camera)


def iod_px(camera: PosedCamera) -> float:
    """Of a head at its place, square on."""
    head = torch.tensor(HEAD_WORLD, dtype=torch.float64)
    return IOD_M * camera.focal_px[0] / -float((camera.rotation @ head + camera.translation_m)[2] + 0.1)


def surface_rms_m(fitted: Tensor, true: Tensor) -> float:
    """RMS distance of corresponding vertices [V, 3] after the best rigid motion."""
    a, b = fitted.double() - fitted.double().mean(0), true - true.mean(0)
    u, _, vh = torch.linalg.svd(a.mT @ b)
    turn = u @ torch.diag(torch.tensor([1.0, 1.0, float(torch.linalg.det(u @ vh))]).double()) @ vh
    return float((a @ turn - b).pow(2).sum(-1).mean().sqrt())


def single_fit(model: MorphableModel, camera: PosedCamera, landmarks_px: np.ndarray) -> Tensor:
    """The head-frame vertices of a fit as a photo gets it."""
    crop = from_landmarks(landmarks_px, 256)
    fit = fit_landmarks(model, crop.to_crop(landmarks_px), crop)
    return model.vertices(fit.alpha[None], fit.beta[None])[0]


Someone = tuple[Tensor, list[np.ndarray]]  # true vertices in the world, landmarks of each camera


def photographed(model: MorphableModel, seed: int, noise_iod: float = 0.012) -> tuple[Tensor, Someone]:
    """The vertices of someone in the head frame, and what the cameras see."""
    head, world = true_head(model, seed)
    views = [seen(model, world, camera, noise_iod, 7 * seed + i) for i, camera in enumerate(CAMERAS)]
    return head, (world, views)


@pytest.fixture(scope="module")
def someone(model: MorphableModel) -> Someone:
    return photographed(model, 1)[1]


def test_all_cameras_together_know_the_shape_best(model: MorphableModel) -> None:
    together_m, alone_m, mean_m = [], [], []
    for seed in range(6):
        head, (_, landmarks) = photographed(model, seed)
        joint, errors_iod = fit_views(model, CAMERAS, landmarks)
        assert max(errors_iod) <= 0.03
        alone = [single_fit(model, camera, px) for camera, px in zip(CAMERAS, landmarks, strict=True)]
        fitted = model.vertices(joint.alpha.float(), joint.beta.float())[0]
        together_m.append(surface_rms_m(fitted, head))
        alone_m.append([surface_rms_m(vertices, head) for vertices in alone])
        mean_m.append(surface_rms_m(torch.stack(alone).mean(0), head))
    better = np.array(together_m) < np.minimum(np.min(alone_m, 1), mean_m)
    assert better.sum() >= 5  # of six: noise may favour one camera
    assert np.mean(together_m) < 0.85 * min(*np.mean(alone_m, 0), np.mean(mean_m))


def error_against(model: MorphableModel, joint: Heads, world: Tensor, camera: PosedCamera) -> float:
    """Mean distance of the fit's landmarks to the true ones in a camera, over the inter-ocular distance."""
    a, b = (camera.project(model.landmarks(v[None])[0]) for v in (joint.vertices(model)[0], world))
    return float((a - b).norm(dim=-1).mean()) / iod_px(camera)


@pytest.mark.parametrize("blind", [0, 2])
def test_a_camera_without_landmarks_is_fitted_by_the_calibration(
    model: MorphableModel, someone: Someone, blind: int
) -> None:
    world, landmarks = someone
    given = [None if index == blind else px for index, px in enumerate(landmarks)]
    joint, errors_iod = fit_views(model, CAMERAS, given)
    assert np.flatnonzero(np.isnan(errors_iod)).tolist() == [blind]
    assert error_against(model, joint, world, CAMERAS[blind]) < 0.04


def test_the_world_may_lie_anywhere(model: MorphableModel, someone: Someone) -> None:
    _, landmarks = someone
    turn = pose_to_rotation(100, 70, -30).double()
    shift = torch.tensor([5.0, -3.0, 8.0]).double()
    turns = [camera.rotation @ turn.mT for camera in CAMERAS]
    moved_cameras = [
        replace(camera, rotation=moved, translation_m=camera.translation_m - moved @ shift)
        for camera, moved in zip(CAMERAS, turns, strict=True)
    ]
    here, there = (fit_views(model, cameras, landmarks)[0] for cameras in (CAMERAS, moved_cameras))
    assert torch.allclose(here.alpha, there.alpha, atol=1e-6)
    expected = here.vertices(model) @ turn.mT + shift
    assert (there.vertices(model) - expected).abs().max() < 1e-6


def test_one_camera_is_a_single_fit_and_a_face_that_is_none_is_left_out(
    model: MorphableModel, someone: Someone
) -> None:
    world, landmarks = someone
    joint, errors_iod = fit_views(model, CAMERAS[1:2], landmarks[1:2])
    assert errors_iod[0] < 0.03
    assert error_against(model, joint, world, CAMERAS[1]) < 0.03
    wrong = [px if index != 1 else px[::-1] + 90 for index, px in enumerate(landmarks)]
    joint, errors_iod = fit_views(model, CAMERAS, wrong)
    assert np.isnan(errors_iod).tolist() == [False, True, False, False]
    assert error_against(model, joint, world, CAMERAS[1]) < 0.04
    refused(InputError, "no camera", fit_views, model, CAMERAS, [None] * len(CAMERAS))


@pytest.mark.parametrize(("distance_m", "most_iod"), [(0.8, 0.005), (1.5, 0.008), (10.0, 0.018)])
def test_the_crop_sees_the_head_where_the_camera_does_with_no_more_pixels_than_the_image(
    model: MorphableModel, distance_m: float, most_iod: float
) -> None:
    _, world = true_head(model, 5)
    cameras = [camera_at(yaw_deg, distance_m) for yaw_deg in YAWS_DEG]
    joint, _ = fit_views(model, cameras, [seen(model, world, camera, 0.0, 0) for camera in cameras])
    for camera in cameras:
        fit, left_iod = fit_in_crop(model, joint, camera, None, 0.01, 256)
        assert left_iod < most_iod
        landmarks = model.landmarks(fit.vertices_camera(model)[None])[0]
        there = model.landmarks(joint.vertices(model).float())[0]
        off_px = project(landmarks, fit.camera).numpy() - fit.crop.to_crop(camera.project(there).numpy())
        assert np.linalg.norm(off_px, axis=-1).mean() < 2 * most_iod * iod_px(camera) * fit.crop.scale
        assert torch.equal(fit.alpha, joint.alpha[0].float()) and fit.quality == "good"
        # the chain through the head is the camera's own rotation, but for the crop's small turn
        turn = fit.rotation.double() @ (camera.rotation @ joint.rotation[0]).mT
        assert math.degrees(math.acos(min(1, (float(turn.trace()) - 1) / 2))) < 4
        near = replace(camera, focal_px=(4000.0, 4000.0), width_px=4000, height_px=4000)
        own, large = (fit_in_crop(model, joint, each, None, 0.01, None)[0].crop for each in (camera, near))
        assert own.side_px - 8 < own.size_px <= own.side_px or own.size_px == 256 < own.side_px
        assert own.size_px % 8 == 0 and large.size_px <= min(256, large.side_px)
        assert fit_in_crop(model, joint, camera, None, 0.01, 512)[0].crop.size_px == 512  # on request


def test_a_crop_needs_the_front_of_the_face(model: MorphableModel) -> None:
    _, world = true_head(model, 5)
    joint, _ = fit_views(model, CAMERAS, [seen(model, world, camera, 0.0, 0) for camera in CAMERAS])
    head = torch.tensor(HEAD_WORLD, dtype=torch.float64)
    away = PosedCamera((4000.0, 4000.0), (200.0, 200.0), 400, 400, torch.eye(3).double(), 0 * head)
    behind = replace(away, rotation=torch.diag(torch.tensor([-1.0, 1.0, -1.0]).double()))
    for camera in (away, behind):
        shift = torch.tensor([0.0, 0.0, 1.0 if camera is away else -1.2]).double()
        with pytest.raises(InputError, match="behind the head"):
            fit_in_crop(
                model, joint, replace(camera, translation_m=shift - camera.rotation @ head), None, 0.01, 256
            )
