"""The fit finds what made the landmarks, and says so where nothing could."""

from dataclasses import replace

import numpy as np
import pytest
import skimage.data
import torch

from facerf_cli.errors import InputError
from facerf_cli.face.crop import Crop, from_landmarks
from facerf_cli.face.fit import (
    FitSettings,
    FitStart,
    better_start,
    fit_basis,
    fit_batch,
    fit_from_arrays,
    fit_landmarks,
    fit_problem,
    fit_to_arrays,
    load_fit,
    save_fit,
    seeded_state,
    trust_inside,
)
from facerf_cli.face.gauss_newton import (
    Problem,
    apply_step,
    fit_points,
    jacobian,
    minimise,
    pose_from_landmarks,
    residuals,
    total_cost,
    weak_perspective,
)
from facerf_cli.face.morphable import load_face_model
from facerf_cli.face.topology import CONTOUR, LANDMARKS_M, grid_triangles
from facerf_cli.portrait.find import detect_faces
from facerf_cli.raster.camera import crop_camera, pose_to_rotation, project
from facerf_cli.raster.rasterize import rasterize
from facerf_cli.relighting.models import SHIPPED_NETWORKS
from tests.refusals import refused

CAMERA = crop_camera(256)
CROP = Crop(10.0, 20.0, 512.0, 256)
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
    assert fit.alpha.abs().max() < 1e-2 and fit.error_iod.item() < 1e-5


def test_priors_hold_the_shape_as_strongly_as_they_are_weighed(model):
    landmarks_px = see(model, *coefficients(model, 0.5), (12, 5, 3))
    assert fit_batch(model, landmarks_px, CAMERA, WEAK, INNER_ONLY).error_iod.item() < 2e-3
    landmarks_px = see(model, *coefficients(model, 1), (12, 5, 3))
    weak = fit_batch(model, landmarks_px, CAMERA, WEAK)
    strong = fit_batch(model, landmarks_px, CAMERA, FitSettings(identity_std=0.01, expression_std=0.01))
    assert strong.alpha.norm() < 0.02 < 0.1 * weak.alpha.norm()
    still = replace(model, identity=model.identity[:1] * 0, expression=model.expression[:1] * 0)
    landmarks_px = see(still, *coefficients(still, 0, batch=2), (25, -10, 5))
    fit = fit_batch(still, landmarks_px, CAMERA, FitSettings(steps=40), INNER_ONLY.expand(2, -1))
    assert angle_deg(fit.rotation[1], pose_to_rotation(25, -10, 5)) < 0.02
    assert fit.alpha.shape == fit.beta.shape == (2, 1) and fit.error_iod.max() < 1e-5


def test_the_cost_is_that_of_landmarks_and_of_priors(model):
    """Huber's cost of the differences in deviations of their noise, and squared coordinates."""
    target_px = see(model, *coefficients(model, 0.5), (12, 5, 3))
    problem, start = fit_problem(model, target_px, CAMERA, FitSettings(), torch.ones(1, 68).double())
    state = replace(start, coordinates=torch.full_like(start.coordinates, 0.5))
    distance = residuals(problem, state).difference_px.norm(dim=-1) * problem.inverse_noise
    robust = torch.where(distance <= 2, distance**2, 2 * (2 * distance - 2)).sum(1)
    prior = 0.25 * state.coordinates.shape[1]
    torch.testing.assert_close(total_cost(problem, state), robust + prior)


def test_the_jacobian_is_the_derivative(model):
    basis = fit_basis(model, FitSettings())
    target_px = see(model, *coefficients(model, 0.5, batch=2), (20, -8, 10)).double()
    problem = Problem(basis, target_px, CAMERA, torch.full((2, 68), 0.3).double(), 2.0)
    state = minimise(problem, weak_perspective(basis, target_px, CAMERA)[0], steps=2)
    at = residuals(problem, state)
    analytic = jacobian(problem, state, at)
    size = analytic.shape[-1]

    def landmarks_px(step):
        there = apply_step(state, step)
        head = basis.mean[at.ids] + (basis.modes[at.ids] @ there.coordinates[:, None, :, None])[..., 0]
        return project(head @ there.rotation.mT + there.translation_m[:, None], CAMERA)

    for column in [*range(8), size // 2, size - 1]:
        step = 1e-6 * torch.eye(size, dtype=torch.float64)[column].expand(2, -1)
        numeric = (landmarks_px(step) - landmarks_px(-step)) / 2e-6
        assert torch.allclose(analytic[..., column], numeric, rtol=1e-5, atol=1e-5)


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
    assert (few.error_iod - many.error_iod).abs().item() < 2e-3
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
    assert torch.allclose(a.alpha, b.alpha, atol=1e-9) and torch.allclose(a.error_iod, b.error_iod)


@pytest.mark.parametrize("yaw", [25, -25])
def test_the_far_jaw_slides_along_the_silhouette(model, yaw):
    camera = crop_camera(256)
    rotation, translation = pose_to_rotation(yaw, 0, 0), torch.tensor([0.0, 0.01, -0.95])
    vertices = model.mean @ rotation.mT + translation
    seen = rasterize(vertices, grid_triangles(), camera).triangle >= 0
    start = see(model, *coefficients(model, 0), (yaw, 0, 0), translation.tolist()).double()
    basis = fit_basis(model, FitSettings())
    problem = Problem(basis, start, camera, torch.ones(1, 68).double(), 2.0)
    state = weak_perspective(basis, start, camera)[0]
    state = replace(state, rotation=rotation[None].double(), translation_m=translation[None].double())
    found_px = (residuals(problem, state).difference_px + start)[0]
    far = range(12, 16) if yaw > 0 else range(1, 5)
    for landmark in far:
        x, y = found_px[landmark].tolist()
        columns = seen[int(y)].nonzero()[:, 0]
        edge = columns.max().item() + 1 if yaw > 0 else columns.min().item()
        assert abs(x - edge) < 2, (landmark, x, edge)


@pytest.mark.parametrize("bad", [np.full((68, 2), 7.0), np.full((68, 2), np.nan), np.zeros((5, 2))])
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


SETTINGS = FitSettings(steps=60)
INNER_POINTS = torch.from_numpy(LANDMARKS_M[17:])[None]


@pytest.fixture(scope="module")
def landmarks_px(model):
    """Of six people who look left and right, with the errors of a detector."""
    generator = torch.Generator().manual_seed(4)
    alpha = torch.randn(6, len(model.identity), generator=generator)
    beta = 0.7 * torch.randn(6, len(model.expression), generator=generator)
    turns = torch.stack([pose_to_rotation(yaw, 5, 3) for yaw in (-40, -25, -10, 10, 25, 40)])
    vertices = model.vertices(alpha, beta) @ turns.mT + torch.tensor([0.01, -0.02, -0.95])
    px = project(model.landmarks(vertices), CAMERA)
    return px + 0.8 * torch.randn(px.shape, generator=generator)


@pytest.fixture(scope="module")
def cold(model, landmarks_px):
    return fit_batch(model, landmarks_px, CAMERA, SETTINGS)


def start_at(fit):
    return FitStart(fit.rotation, fit.translation_m, fit.alpha, fit.beta)


def steps_needed(problem, state, most=12):
    """Steps of each face until its cost is within 1 % of where it ends."""
    final = total_cost(problem, minimise(problem, state, 40))
    costs = torch.stack([total_cost(problem, minimise(problem, state, n)) for n in range(most)])
    return (costs > 1.01 * final).sum(0)


def test_a_good_start_ends_where_the_cold_one_does_in_fewer_steps(model, landmarks_px, cold):
    warm = fit_batch(model, landmarks_px, CAMERA, SETTINGS, start=start_at(cold))
    assert (warm.error_iod - cold.error_iod).abs().max() < 2e-4
    moved_m = warm.vertices_camera(model) - cold.vertices_camera(model)
    assert moved_m.norm(dim=-1).max() < 1e-3
    trust = torch.ones(6, 68, dtype=torch.float64)
    problem, begin = fit_problem(model, landmarks_px.double(), CAMERA, SETTINGS, trust)
    warm = better_start(problem, begin, start_at(cold))
    assert 2 * steps_needed(problem, warm).sum() <= steps_needed(problem, begin).sum()
    start = replace(start_at(cold), alpha=cold.alpha[:, :10], beta=cold.beta[:, :0])
    warm = fit_batch(model, landmarks_px, CAMERA, SETTINGS, start=start)
    assert (warm.error_iod - cold.error_iod).abs().max() < 1e-3
    crop = Crop(0.0, 0.0, 512.0, 256)
    start = FitStart(*(x[:1] for x in (cold.rotation, cold.translation_m, cold.alpha, cold.beta)))
    fit = fit_landmarks(model, landmarks_px[0].numpy(), crop, SETTINGS, start=start)
    assert fit.error_iod == pytest.approx(float(cold.error_iod[0]), abs=2e-4)


def test_the_built_in_model_is_seeded_with_the_start_itself(model, landmarks_px, cold):
    problem, _ = fit_problem(model, landmarks_px.double(), CAMERA, SETTINGS, torch.ones(6, 68).double())
    state = seeded_state(problem.basis, start_at(cold))
    assert (state.rotation - cold.rotation).abs().max() < 0.01
    corners, weights = fit_points()

    def points(fit_vertices):
        return (fit_vertices[:, corners] * weights[..., None]).sum(2)

    head = problem.basis.mean + (state.coordinates @ problem.basis.modes.flatten(0, 1).mT).reshape(6, -1, 3)
    seeded = head @ state.rotation.mT + state.translation_m[:, None]
    assert (seeded - points(cold.vertices_camera(model))).norm(dim=-1).max() < 5e-4


def test_another_model_is_seeded_by_least_squares(model, landmarks_px, cold):
    other = replace(
        model,
        name="other",
        mean=1.05 * model.mean + torch.tensor([0.0, 0.01, -0.005]),
        identity=model.identity[:30].flip(0),
    )
    problem, begin = fit_problem(other, landmarks_px.double(), CAMERA, SETTINGS, torch.ones(6, 68).double())
    seeded = seeded_state(problem.basis, start_at(cold))
    assert (total_cost(problem, seeded) < total_cost(problem, begin)).all()


@pytest.mark.parametrize("wrong", ["behind", "turned", "nan"])
def test_a_useless_start_is_left_aside(model, landmarks_px, cold, wrong):
    start = start_at(cold)
    if wrong == "behind":
        start = replace(start, translation_m=-start.translation_m)
    elif wrong == "turned":
        start = replace(start, rotation=start.rotation @ pose_to_rotation(180, 0, 0).double())
    else:
        start = replace(start, rotation=start.rotation * torch.nan)
    fit = fit_batch(model, landmarks_px, CAMERA, SETTINGS, start=start)
    assert (fit.error_iod - cold.error_iod).abs().max() < 1e-3


@pytest.mark.parametrize("pose", [(0, 0, 0), (30, -10, 5), (-40, 15, -20), (10, 20, 170)])
def test_the_pose_comes_back(pose, distance_m=0.8):
    rotation, translation = (
        pose_to_rotation(*pose).double(),
        torch.tensor([0.02, -0.01, -distance_m]).double(),
    )
    px = project(INNER_POINTS @ rotation.T + translation, CAMERA)
    guess = pose_to_rotation(pose[0] + 12, pose[1] - 8, pose[2] + 6).double()[None]
    at = torch.tensor([[0.0, 0.0, -1.0]], dtype=torch.float64)
    found, where = pose_from_landmarks(INNER_POINTS, px, CAMERA, guess, at)
    angle_deg = torch.rad2deg(2 * torch.asin((found[0] - rotation).norm() / 8**0.5))
    assert angle_deg < 1.0
    assert (where[0] - translation).abs().max() < 0.02 * distance_m
    seen = project(INNER_POINTS @ found.mT + where[:, None], CAMERA)
    assert (seen - px).norm(dim=-1).max() < 1.0
