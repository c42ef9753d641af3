"""The states that a fit starts from: by the landmarks alone, or by a head that a Geometry Network predicts.

The predicted head is a head of the built-in model. A fit of any face model starts from it by least squares:
pose and shape together bring the points of the fit as close as possible to those of the head.
"""

from dataclasses import dataclass
from functools import cache

import torch
from torch import Tensor

from facerf_cli.face.gauss_newton import INNER_COUNT, FitBasis, FitState, Problem, fit_points, total_cost
from facerf_cli.face.morphable import load_face_model
from facerf_cli.face.topology import CONTOUR
from facerf_cli.raster.camera import Camera, pixel_rays, skew_matrix, so3_exp

_POSE_ROUNDS = 6
_SEED_ROUNDS = 2
_NOISE_M = 0.0003  # this distance of a point costs as much as one standard deviation of a coordinate


@dataclass(frozen=True)
class FitStart:
    """Heads of B faces to start from, in the space of the fit's camera; coefficients of the built-in model.

    alpha and beta may have fewer coefficients than the model; the missing ones are zero.
    """

    rotation: Tensor  # [B, 3, 3] head_to_camera
    translation_m: Tensor  # [B, 3]
    alpha: Tensor  # [B, Ki]
    beta: Tensor  # [B, Ke]


def weak_perspective(basis: FitBasis, target_px: Tensor, camera: Camera) -> tuple[FitState, Tensor]:
    """Pose the mean by a scaled orthographic fit to the inner ones of the landmarks target_px [B, 68, 2].

    Returns the state and its pixels per metre [B].
    """
    model = basis.mean[:INNER_COUNT]
    image = target_px[:, len(CONTOUR) :] * torch.tensor([1.0, -1.0], dtype=torch.float64)  # y up
    centred = model - model.mean(0)
    middle = image.mean(1)
    affine = torch.linalg.lstsq(centred.expand(len(image), -1, -1), image - middle[:, None]).solution.mT
    u, stretch, vh = torch.linalg.svd(affine, full_matrices=False)  # affine [B, 2, 3]
    scale = stretch.mean(-1)
    rows = u @ vh
    rotation = torch.cat([rows, torch.linalg.cross(rows[:, :1], rows[:, 1:])], 1)
    depth_m = camera.focal_px / scale
    offset = (middle - torch.tensor([camera.cx_px, -camera.cy_px], dtype=torch.float64)) / scale[:, None]
    translation = torch.cat([offset, -depth_m[:, None]], 1) - rotation @ model.mean(0)
    coordinates = torch.zeros(len(image), basis.modes.shape[-1], dtype=torch.float64)
    return FitState(rotation, translation, coordinates), scale


def better_start(problem: Problem, begin: FitState, start: FitStart) -> FitState:
    """Choose for each face the state of least cost among `begin` and the two of `start_states`.

    Landmarks determine the pose better than a network does, and the network determines the shape better.
    """
    for state in start_states(problem, start):
        cheaper = total_cost(problem, state) < total_cost(problem, begin)  # False for NaN
        begin = state.where(cheaper & (state.translation_m[:, 2] < 0), begin)
    return begin


def start_states(problem: Problem, start: FitStart) -> tuple[FitState, FitState]:
    """The state closest to `start`, and the same shape in the pose that the inner landmarks give."""
    state, basis = seeded_state(problem.basis, start), problem.basis
    offset = state.coordinates @ basis.modes[:INNER_COUNT].flatten(0, 1).mT
    points = basis.mean[:INNER_COUNT] + offset.reshape(len(offset), INNER_COUNT, 3)
    inner_px = problem.target_px[:, -INNER_COUNT:]
    pose = pose_from_landmarks(points, inner_px, problem.camera, state.rotation, state.translation_m)
    return state, FitState(*pose, state.coordinates)


def seeded_state(basis: FitBasis, start: FitStart) -> FitState:
    """The state closest to `start` in the basis of any face model."""
    wanted = _points_camera(start).nan_to_num()
    rotation, translation = start.rotation.double().nan_to_num(), start.translation_m.double().nan_to_num()
    by_parameters = torch.cat(
        [-skew_matrix(basis.mean), torch.eye(3).expand(len(basis.mean), 3, 3), basis.modes], -1
    )
    flat = (by_parameters * _weights()[:, None, None]).flatten(0, 1)
    prior = torch.ones(flat.shape[1], dtype=flat.dtype)
    prior[:6] = 0
    factor = torch.linalg.cholesky(flat.mT @ flat + prior.diag())
    coordinates = torch.zeros(len(wanted), flat.shape[1] - 6, dtype=flat.dtype)
    for _ in range(_SEED_ROUNDS):
        points = basis.mean + (coordinates @ basis.modes.flatten(0, 1).mT).reshape(len(wanted), -1, 3)
        off = (wanted - translation[:, None]) @ rotation - points  # head frame
        right = (off * _weights()[:, None]).flatten(1) @ flat
        right[:, 6:] -= coordinates
        step = torch.cholesky_solve(right.mT, factor).mT
        translation = translation + (rotation @ step[:, 3:6, None])[..., 0]
        rotation = rotation @ so3_exp(step[:, :3])
        coordinates = coordinates + step[:, 6:]
    return FitState(rotation, translation, coordinates)


@cache
def _weights() -> Tensor:
    """Weights [N] of the basis's points in 1 / m; all contour points together count as the inner ones do."""
    corners, _ = fit_points()
    weights = torch.full(
        (len(corners),), (INNER_COUNT / (len(corners) - INNER_COUNT)) ** 0.5, dtype=torch.float64
    )
    weights[:INNER_COUNT] = 1
    return weights / _NOISE_M


def _points_camera(start: FitStart) -> Tensor:
    """The points of `fit_points` [B, N, 3] on the start's heads, camera space, float64."""
    mean, identity, expression = _builtin_points()
    alpha, beta = start.alpha.double(), start.beta.double()
    offset = torch.einsum("bk,knc->bnc", alpha, identity[: alpha.shape[1]])
    offset = offset + torch.einsum("bk,knc->bnc", beta, expression[: beta.shape[1]])
    return (mean + offset) @ start.rotation.double().mT + start.translation_m.double()[:, None]


@cache
def _builtin_points() -> tuple[Tensor, Tensor, Tensor]:
    """Mean [N, 3], identity [Ki, N, 3] and expression [Ke, N, 3] of the built-in model at `fit_points`."""
    model, (corners, weights) = load_face_model(), fit_points()
    mean, identity, expression = (
        (basis[..., corners, :].double() * weights[..., None].double()).sum(-2)
        for basis in (model.mean, model.identity, model.expression)
    )
    return mean, identity, expression


def pose_from_landmarks(
    points: Tensor, px: Tensor, camera: Camera, rotation: Tensor, translation_m: Tensor
) -> tuple[Tensor, Tensor]:
    """Pose heads of known shape: rotations [B, 3, 3] and translations [B, 3], float64, without derivatives.

    points [B, N, 3] in the head frame project to pixels [B, N, 2]; rotation and translation_m are a first
    guess. A scaled orthographic fit at the guess's depths (DeMenthon and Davis, *Model-based object pose in
    25 lines of code*, 1995) precedes a few rounds of orthogonal iteration (Lu, Hager and Mjolsness, *Fast and
    globally convergent pose estimation from video images*, 2000).
    """
    depth_m = -(points @ rotation.mT + translation_m[:, None])[..., 2:]
    rays = pixel_rays(px, camera)
    rotation = _orthographic(points, rays[..., :2] * depth_m)
    line = rays[..., :, None] * rays[..., None, :] / (rays * rays).sum(-1)[..., None, None]  # [B, N, 3, 3]
    off_line = line - torch.eye(3, dtype=rays.dtype)
    middle = torch.linalg.inv(-off_line.mean(1))

    def best_translation(rotation: Tensor) -> Tensor:
        turned = (points @ rotation.mT)[..., None]
        return (middle @ (off_line @ turned).mean(1))[..., 0]

    for _ in range(_POSE_ROUNDS):
        seen = points @ rotation.mT + best_translation(rotation)[:, None]
        rotation = _closest_rotation((line @ seen[..., None])[..., 0], points)
    return rotation, best_translation(rotation)


def _orthographic(points: Tensor, image: Tensor) -> Tensor:
    """Rotations [B, 3, 3] of a scaled orthographic fit of points [B, N, 3] to positions [B, N, 2], y up."""
    centred, flat = points - points.mean(1, keepdim=True), image - image.mean(1, keepdim=True)
    u, _, vh = torch.linalg.svd(torch.linalg.lstsq(centred, flat).solution.mT, full_matrices=False)
    rows = u @ vh
    return torch.cat([rows, torch.linalg.cross(rows[:, :1], rows[:, 1:])], 1)


def _closest_rotation(wanted: Tensor, points: Tensor) -> Tensor:
    """Rotations [B, 3, 3] that bring centred points [B, N, 3] closest to centred `wanted` (Kabsch, 1976)."""
    moment = (wanted - wanted.mean(1, keepdim=True)).mT @ (points - points.mean(1, keepdim=True))
    u, _, vh = torch.linalg.svd(moment)
    signs = torch.ones(len(points), 3, dtype=points.dtype)
    signs[:, 2] = torch.det(u @ vh).sign()
    return u @ (signs[..., None] * vh)
