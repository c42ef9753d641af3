"""Where a fit starts: from the landmarks alone, or from a head that a Geometry Network saw.

That head is one of the built-in model. Any face model is seeded from it by least squares (DESIGN): its points
that the fit may use are laid on those of the head, by pose and shape together.
"""

from dataclasses import dataclass
from functools import cache

import torch
from torch import Tensor

from facerf_cli.face.gauss_newton import INNER_COUNT, FitBasis, FitState, Problem, fit_points
from facerf_cli.face.head_pose import pose_from_landmarks
from facerf_cli.face.morphable import load_face_model
from facerf_cli.raster.camera import skew_matrix, so3_exp

_ROUNDS = 2
_NOISE_M = 0.0003  # a point's distance that weighs as much as one deviation of a coordinate


@dataclass(frozen=True)
class FitStart:
    """Heads of B faces to start from, in the space of the fit's camera; coefficients of the built-in model.

    There may be fewer coefficients than the model has: the others are zero.
    """

    rotation: Tensor  # [B, 3, 3] head_to_camera
    translation_m: Tensor  # [B, 3]
    alpha: Tensor  # [B, Ki]
    beta: Tensor  # [B, Ke]


def started(problem: Problem, start: FitStart) -> tuple[FitState, FitState]:
    """A fit's states at the start: as it is, and of its shape with the pose that the inner landmarks give."""
    state, basis = seeded_state(problem.basis, start), problem.basis
    offset = state.coordinates @ basis.modes[:INNER_COUNT].flatten(0, 1).mT
    points = basis.mean[:INNER_COUNT] + offset.reshape(len(offset), INNER_COUNT, 3)
    inner_px = problem.target_px[:, -INNER_COUNT:]
    pose = pose_from_landmarks(points, inner_px, problem.camera, state.rotation, state.translation_m)
    return state, FitState(*pose, state.coordinates)


def seeded_state(basis: FitBasis, start: FitStart) -> FitState:
    """The state of a fit, of whatever model, that comes closest to the start."""
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
    for _ in range(_ROUNDS):
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
    """Of the basis's points [N], 1 / m: the contour's many count as much together as the inner ones."""
    corners, _ = fit_points()
    weights = torch.full(
        (len(corners),), (INNER_COUNT / (len(corners) - INNER_COUNT)) ** 0.5, dtype=torch.float64
    )
    weights[:INNER_COUNT] = 1
    return weights / _NOISE_M


def _points_camera(start: FitStart) -> Tensor:
    """The start's points [B, N, 3] where a fit's basis has them, camera space, float64."""
    mean, identity, expression = _builtin_points()
    alpha, beta = start.alpha.double(), start.beta.double()
    offset = torch.einsum("bk,knc->bnc", alpha, identity[: alpha.shape[1]])
    offset = offset + torch.einsum("bk,knc->bnc", beta, expression[: beta.shape[1]])
    return (mean + offset) @ start.rotation.double().mT + start.translation_m.double()[:, None]


@cache
def _builtin_points() -> tuple[Tensor, Tensor, Tensor]:
    """Mean [N, 3], identity [Ki, N, 3] and expression [Ke, N, 3] of the built-in model at a fit's points."""
    model, (corners, weights) = load_face_model(), fit_points()
    mean, identity, expression = (
        (basis[..., corners, :].double() * weights[..., None].double()).sum(-2)
        for basis in (model.mean, model.identity, model.expression)
    )
    return mean, identity, expression
