"""The solver's cost, derivatives and starts; many heads in many cameras are those heads one by one."""

from dataclasses import replace

import pytest
import torch

from facerf_cli.face import gauss_newton
from facerf_cli.face.fit import FitSettings, fit_heads, fit_problem, views_of_photos
from facerf_cli.face.gauss_newton import (
    Views,
    apply_step,
    cost_of,
    jacobian,
    least_from_pitches,
    minimise,
    residuals,
)
from facerf_cli.face.morphable import load_face_model
from facerf_cli.face.topology import grid_triangles
from facerf_cli.raster.camera import PLANE, crop_camera, pose_to_rotation, project
from facerf_cli.raster.rasterize import rasterize

CAMERA = crop_camera(256)
ALL = torch.ones(1, 68, dtype=torch.float64)
TURNS = torch.stack([pose_to_rotation(yaw, 5, 3) for yaw in (-40, -25, -10, 10, 25, 40)]).double()


@pytest.fixture(scope="module")
def model():
    return load_face_model()


def people(model, turns, noise_px=0.0, seed=4):
    """The meshes [B, V, 3] of people in camera space, and their landmarks [B, 68, 2] in pixels."""
    generator = torch.Generator().manual_seed(seed)
    alpha = torch.randn(len(turns), len(model.identity), generator=generator)
    beta = 0.7 * torch.randn(len(turns), len(model.expression), generator=generator)
    vertices = model.vertices(alpha, beta).double() @ turns.mT + torch.tensor([0.01, -0.02, -0.95])
    px = project(model.landmarks(vertices), CAMERA)
    return vertices, px + noise_px * torch.randn(px.shape, generator=generator)


def photographed(model, turns, noise_px=0.0, seed=4):
    px = people(model, turns, noise_px, seed)[1]
    return views_of_photos(px, CAMERA, ALL.expand(len(px), -1))


def two_heads(model):
    """The first head in two cameras, the second in one."""
    vertices, _ = people(model, TURNS[:2])
    head = torch.tensor([0, 0, 1])
    turn = torch.stack([torch.eye(3), pose_to_rotation(30, 0, 0), pose_to_rotation(0, 8, 5)]).double()
    middle = torch.tensor([0.0, 0.0, -0.95], dtype=torch.float64)
    shift_m = middle + torch.tensor([0.0, 0.0, -0.1]) - turn @ middle
    seen = vertices[head] @ turn.mT + shift_m[:, None]
    return Views(project(model.landmarks(seen), PLANE), ALL.expand(3, -1), head, turn, shift_m)


def test_the_jacobian_is_the_derivative(model):
    problem, alone = fit_problem(model, two_heads(model), FitSettings())
    state, _ = minimise(problem, alone.rows(torch.tensor([0, 2])), steps=2)
    at, basis, views = residuals(problem, state), problem.basis, problem.views
    analytic = jacobian(problem, at)
    size = analytic.shape[-1]

    def landmarks(step):
        there = apply_step(state, step)
        points = (
            basis.mean[at.ids] + (basis.modes[at.ids] @ there.coordinates[views.head, None, :, None])[..., 0]
        )
        rotation, place = views.poses(there.rotation, there.translation_m)
        return project(points @ rotation.mT + place[:, None], PLANE)

    for column in [*range(8), size // 2, size - 1]:
        step = 1e-6 * torch.eye(size, dtype=torch.float64)[column].expand(2, -1)
        numeric = (landmarks(step) - landmarks(-step)) / 2e-6
        assert torch.allclose(analytic[..., column], numeric, rtol=1e-5, atol=1e-7)


@pytest.mark.parametrize("yaw", [25, -25])
def test_the_far_jaw_slides_along_the_silhouette(model, yaw):
    rotation, translation = pose_to_rotation(yaw, 0, 0), torch.tensor([0.0, 0.01, -0.95])
    vertices = model.mean @ rotation.mT + translation
    seen = rasterize(vertices, grid_triangles(), CAMERA).triangle >= 0
    target_px = project(model.landmarks(vertices[None]), CAMERA).double()
    problem, state = fit_problem(model, views_of_photos(target_px, CAMERA, ALL), FitSettings())
    state = replace(state, rotation=rotation[None].double(), translation_m=translation[None].double())
    found_px = (residuals(problem, state).difference * CAMERA.focal_px + target_px)[0]
    far = range(12, 16) if yaw > 0 else range(1, 5)
    for landmark in far:
        x, y = found_px[landmark].tolist()
        columns = seen[int(y)].nonzero()[:, 0]
        edge = columns.max().item() + 1 if yaw > 0 else columns.min().item()
        assert abs(x - edge) < 2, (landmark, x, edge)


def test_the_least_cost_of_three_pitches_wins(model, monkeypatch):
    problem, alone = fit_problem(model, photographed(model, TURNS, 1.5), FitSettings())

    def costs(*pitches_deg):
        monkeypatch.setattr(gauss_newton, "_PITCHES_DEG", pitches_deg)
        state = least_from_pitches(problem, alone, 40)
        return cost_of(problem, state, residuals(problem, state))

    together = costs(*gauss_newton._PITCHES_DEG)
    each = torch.stack([costs(0.0), costs(10.0), costs(-10.0)])
    torch.testing.assert_close(together, each.amin(0), rtol=1e-9, atol=0)
    assert (each > (1 + 5e-5) * together).any(1).all()  # no one start finds them all


def test_heads_in_any_number_of_cameras_are_fitted_as_if_each_was_alone(model):
    views = two_heads(model)
    together = fit_heads(model, views, FitSettings())
    for index, rows in enumerate(([0, 1], [2])):
        own = replace(views.rows(torch.tensor(rows)), head=torch.zeros(len(rows), dtype=torch.int64))
        alone = fit_heads(model, own, FitSettings())
        torch.testing.assert_close(
            alone.vertices(model)[0], together.vertices(model)[index], rtol=0, atol=1e-6
        )
        torch.testing.assert_close(alone.off, together.off[rows], rtol=0, atol=1e-6)
