"""A start from a Geometry Network saves steps and hardly changes the result; poses come from landmarks."""

from dataclasses import replace

import pytest
import torch

from facerf_cli.face.crop import Crop
from facerf_cli.face.fit import (
    FitSettings,
    FitStart,
    better_start,
    fit_batch,
    fit_landmarks,
    fit_problem,
    seeded_state,
)
from facerf_cli.face.gauss_newton import fit_points, minimise, pose_from_landmarks, total_cost
from facerf_cli.face.morphable import load_face_model
from facerf_cli.face.topology import LANDMARKS_M
from facerf_cli.raster.camera import crop_camera, pose_to_rotation, project

CAMERA = crop_camera(256)
SETTINGS = FitSettings(steps=60)
INNER_POINTS = torch.from_numpy(LANDMARKS_M[17:])[None]


@pytest.fixture(scope="module")
def model():
    return load_face_model()


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
