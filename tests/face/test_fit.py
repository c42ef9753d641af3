"""The fit finds what made the landmarks, and says so where nothing could."""

from dataclasses import replace

import numpy as np
import pytest
import skimage.data
import torch

from facerf_cli.errors import InputError
from facerf_cli.face.crop import Crop, from_landmarks
from facerf_cli.face.fit import (
    IOD_M,
    FitSettings,
    fit_batch,
    fit_from_arrays,
    fit_landmarks,
    fit_to_arrays,
    load_fit,
    save_fit,
    trust_inside,
)
from facerf_cli.face.morphable import load_face_model
from facerf_cli.face.topology import CONTOUR
from facerf_cli.portrait.find import detect_faces
from facerf_cli.raster.camera import crop_camera, pose_to_rotation, project
from facerf_cli.relighting.models import SHIPPED_NETWORKS
from tests.refusals import refused

CAMERA = crop_camera(256)
CROP = Crop(10.0, 20.0, 512.0, 256)
OFF_OF_IOD = IOD_M / 0.95  # the distance of the eyes in the image over the focal length
INNER_ONLY = torch.ones(1, 68).index_fill(1, torch.tensor(CONTOUR), 0)
POSES = [(0, 0, 0), (25, -10, 5), (-35, 15, -20), (10, 20, 170)]
WEAK = FitSettings(identity_std=30, expression_std=30, steps=60)


@pytest.fixture(scope="module")
def model():
    return load_face_model()


def see(model, alpha, beta, pose, translation_m=(0.012, -0.02, -0.95)):
    """Landmarks [B, 68, 2] in the crop's pixels."""
    vertices = model.vertices(alpha, beta) @ pose_to_rotation(*pose).mT + torch.tensor(translation_m)
    return project(model.landmarks(vertices), CAMERA)


def coefficients(model, scale, batch=1, seed=0):
    generator = torch.Generator().manual_seed(seed)
    alpha = scale * torch.randn(batch, len(model.identity), generator=generator)
    return alpha, scale * torch.randn(batch, len(model.expression), generator=generator)


def angle_deg(a, b):
    """Between rotations; by the chord, for acos is blunt near zero."""
    return torch.rad2deg(2 * torch.asin((a.double() - b.double()).norm() / 8**0.5)).item()


@pytest.mark.parametrize("pose", POSES)
def test_the_pose_of_the_mean_is_found_exactly(model, pose):
    landmarks_px = see(model, *coefficients(model, 0), pose)
    fit = fit_batch(model, landmarks_px, CAMERA, FitSettings(steps=40), INNER_ONLY)
    assert angle_deg(fit.rotation[0], pose_to_rotation(*pose)) < 0.02
    assert fit.translation_m[0].numpy() == pytest.approx([0.012, -0.02, -0.95], abs=2e-4)
    assert fit.alpha.abs().max() < 1e-2 and fit.off.item() < OFF_OF_IOD * 1e-5


def test_priors_hold_the_shape_as_strongly_as_they_are_weighed(model):
    landmarks_px = see(model, *coefficients(model, 0.5), (12, 5, 3))
    assert fit_batch(model, landmarks_px, CAMERA, WEAK, INNER_ONLY).off.item() < OFF_OF_IOD * 2e-3
    landmarks_px = see(model, *coefficients(model, 1), (12, 5, 3))
    weak = fit_batch(model, landmarks_px, CAMERA, WEAK)
    strong = fit_batch(model, landmarks_px, CAMERA, FitSettings(identity_std=0.01, expression_std=0.01))
    assert strong.alpha.norm() < 0.02 < 0.1 * weak.alpha.norm()
    still = replace(model, identity=model.identity[:1] * 0, expression=model.expression[:1] * 0)
    landmarks_px = see(still, *coefficients(still, 0, batch=2), (25, -10, 5))
    fit = fit_batch(still, landmarks_px, CAMERA, FitSettings(steps=40), INNER_ONLY.expand(2, -1))
    assert angle_deg(fit.rotation[1], pose_to_rotation(25, -10, 5)) < 0.02
    assert fit.alpha.shape == fit.beta.shape == (2, 1) and fit.off.max() < OFF_OF_IOD * 1e-5


def test_a_batch_is_its_faces_one_by_one_and_steps_never_raise_the_cost(model):
    alpha, beta = coefficients(model, 0.4, batch=len(POSES))
    landmarks_px = torch.cat([see(model, alpha[[i]], beta[[i]], pose) for i, pose in enumerate(POSES)])
    together = fit_batch(model, landmarks_px, CAMERA)
    for index in range(len(POSES)):
        alone = fit_batch(model, landmarks_px[[index]], CAMERA)
        assert torch.allclose(alone.alpha[0], together.alpha[index], atol=1e-5)
        assert torch.allclose(alone.translation_m[0], together.translation_m[index], atol=1e-6)
    landmarks_px = see(model, *coefficients(model, 0.8), (20, 5, 0))
    few, many = (fit_batch(model, landmarks_px, CAMERA, FitSettings(steps=steps)) for steps in (20, 60))
    assert (few.off - many.off).abs().item() < OFF_OF_IOD * 2e-3
    assert angle_deg(few.rotation[0], many.rotation[0]) < 0.5


def test_wrong_landmarks_are_not_believed_and_those_without_trust_count_for_nothing(model):
    landmarks_px = see(model, *coefficients(model, 0.2), (5, 0, 0))
    wrong = landmarks_px.clone()
    wrong[0, 33] += 40
    right, off = (fit_batch(model, points, CAMERA) for points in (landmarks_px, wrong))
    quadratic = fit_batch(model, wrong, CAMERA, FitSettings(huber=1e6))
    assert angle_deg(right.rotation[0], off.rotation[0]) < 4
    assert angle_deg(right.rotation[0], off.rotation[0]) < 0.5 * angle_deg(
        right.rotation[0], quadratic.rotation[0]
    )
    landmarks_px = see(model, *coefficients(model, 0.3), (5, 0, 0))
    wrong = landmarks_px.clone()
    wrong[0, :5] += 60
    trust = torch.ones(1, 68)
    trust[0, :5] = 0
    a, b = (fit_batch(model, points, CAMERA, trust=trust) for points in (landmarks_px, wrong))
    assert torch.allclose(a.alpha, b.alpha, atol=1e-9) and torch.allclose(a.off, b.off)


ON_A_LINE = np.stack([np.arange(68.0), np.zeros(68)], -1)


@pytest.mark.parametrize("bad", [np.full((68, 2), np.nan), np.zeros((5, 2)), ON_A_LINE])
def test_degenerate_landmarks_are_an_input_error(model, bad):
    with pytest.raises(InputError):
        fit_landmarks(model, bad, CROP)
    with pytest.raises(InputError):
        fit_batch(model, torch.from_numpy(np.stack([bad, bad])), CAMERA)


def test_a_fit_survives_its_file_which_holds_nothing_of_memory(model, tmp_path):
    fit = fit_landmarks(model, see(model, *coefficients(model, 0.3), (9, 3, 1))[0].numpy(), CROP)
    save_fit(tmp_path / "fit.npz", fit)
    again = load_fit(tmp_path / "fit.npz")
    assert again.crop == fit.crop and again.model == model.name and again.quality == fit.quality
    assert torch.equal(again.vertices_camera(model), fit.vertices_camera(model))
    fit = fit_landmarks(model, see(model, *coefficients(model, 0), (0, 0, 0))[0].numpy(), CROP)
    error_iod = 0.03456789123
    a, b = (replace(fit, error_iod=error) for error in (error_iod, np.nextafter(error_iod, 1)))
    assert a.error_iod != b.error_iod
    assert fit_to_arrays(a)["error_iod"].tobytes() == fit_to_arrays(b)["error_iod"].tobytes()
    (tmp_path / "text.npz").write_text("hello")
    np.savez(tmp_path / "other.npz", a=np.zeros(3))
    np.savez(tmp_path / "endless.npz", **fit_to_arrays(fit) | {"size_px": np.inf})
    for name in ("text.npz", "other.npz", "endless.npz", "missing.npz"):
        refused(InputError, name, load_fit, tmp_path / name)


@pytest.mark.parametrize(
    ("name", "value"),
    [("alpha", np.zeros((80, 2))), ("rotation", np.full((3, 3), np.nan)), ("x0_px", np.inf)],
)
def test_arrays_that_are_no_fit_are_refused(model, name, value):
    arrays = fit_to_arrays(
        fit_landmarks(model, see(model, *coefficients(model, 0), (0, 0, 0))[0].numpy(), CROP)
    )
    assert fit_from_arrays(arrays).crop == CROP
    with pytest.raises(ValueError, match=r"coefficients|finite"):
        fit_from_arrays(arrays | {name: np.asarray(value)})


def test_a_fit_knows_its_model_its_quality_and_the_turn_to_another(model):
    fit = fit_landmarks(model, see(model, *coefficients(model, 0), (0, 0, 0))[0].numpy(), CROP)
    assert fit.quality == "good"
    assert [replace(fit, error_iod=error).quality for error in (0.045, 0.06, 0.2)] == ["good", "fair", "poor"]
    refused(ValueError, "other", fit.vertices_camera, replace(model, name="other"))
    # Vectors in camera space, as normals are: N_t = turn N_s.
    source, target = pose_to_rotation(30.0, 10.0, 5.0), pose_to_rotation(-20.0, 0.0, 15.0)
    fit = replace(
        fit_landmarks(model, see(model, *coefficients(model, 0), (0, 0, 0))[0].numpy(), CROP), rotation=source
    )
    normals_head = torch.randn(5, 3, generator=torch.Generator().manual_seed(0))
    turned = normals_head @ source.T @ fit.turn_to(target).T
    torch.testing.assert_close(turned, normals_head @ target.T)


def test_jaw_points_at_the_border_of_a_tight_crop_are_dropped():
    landmarks_px = CROP.to_crop(np.stack([np.linspace(0, 168, 68), np.full(68, 90.0)], -1))
    trust = trust_inside(landmarks_px, CROP, 192, 168)
    assert trust[0] == 0 and trust[5] == 1 and trust[17:].all()


def test_a_smile_is_followed(model):
    face = detect_faces(SHIPPED_NETWORKS.people, skimage.data.astronaut())[0]
    crop = from_landmarks(face.landmarks_px, 256)
    fit = fit_landmarks(model, crop.to_crop(face.landmarks_px), crop)
    assert fit.error_iod <= 0.045
    assert np.linalg.norm(face.landmarks_px[30] - [222, 133]) < 15  # the nose, not the badge on her arm
    smile = [fit.beta[i] for i, name in enumerate(model.expression_names) if name.startswith("smile")]
    assert min(smile) > 0.5
