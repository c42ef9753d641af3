"""Damped Gauss-Newton on projected landmarks, for B faces at once in float64; `face/fit.py` sets it up.

Contour landmarks slide along the jaw: each one is compared with the closest point of the mesh's silhouette,
which is found again at every step (paper, 'Landmark loss').
"""

from collections.abc import Callable
from dataclasses import dataclass, fields
from typing import Self

import numpy as np
import torch
from torch import Tensor

from facerf_cli.face.topology import (
    CONTOUR,
    LANDMARK_UV,
    POINTS_PER_RAY,
    RAYS_PER_LANDMARK,
    band_uv,
    locate,
    outermost,
)
from facerf_cli.raster.camera import Camera, pixel_rays, project, skew_matrix, so3_exp

INNER_COUNT = 68 - len(CONTOUR)
_FIRST_DAMPING = 1e-3
_SETTLED = 1e-7  # a face has settled when a step lowers its cost by less than this share
_STUCK = 1e3  # or when no step lowers its cost at this damping
_POSE_ROUNDS = 6
_WINDOW = 2 * RAYS_PER_LANDMARK  # a contour landmark slides by at most two landmarks along the jaw


class _Batched:
    """Dataclasses of tensors whose first axis is the face."""

    def where(self, accept: Tensor, other: Self) -> Self:
        """Select these faces where accept [B] is true, else the other's."""
        names = [field.name for field in fields(self)]  # type: ignore[arg-type]
        pairs = ((getattr(self, name), getattr(other, name)) for name in names)
        return type(self)(*(torch.where(accept.reshape(-1, *[1] * (a.ndim - 1)), a, b) for a, b in pairs))


@dataclass(frozen=True)
class FitBasis:
    """The model at the N points that a fit uses: the inner landmarks, then the contour's band ray by ray.

    The fit works in Q coordinates with standard normal priors: the whitened coefficients in an orthonormal
    basis, without the directions that move none of these points.
    """

    mean: Tensor  # [N, 3]
    modes: Tensor  # [N, 3, Q]
    spread: Tensor  # [K, Q], coordinates to coefficients, identity then expression
    outward: Tensor  # [rays, 3], head frame


def fit_points() -> tuple[Tensor, Tensor]:
    """Vertex ids [N, 3] and barycentric weights [N, 3] of the points of every model's FitBasis."""
    return locate(np.concatenate([LANDMARK_UV[len(CONTOUR) :], band_uv().reshape(-1, 2)]))


@dataclass(frozen=True)
class FitState(_Batched):
    """Pose and shape of B faces."""

    rotation: Tensor  # [B, 3, 3], head to camera
    translation_m: Tensor  # [B, 3]
    coordinates: Tensor  # [B, Q], see FitBasis


@dataclass(frozen=True)
class Residuals(_Batched):
    """Landmark differences in pixels, and the points of the basis where they are taken."""

    difference_px: Tensor  # [B, 68, 2]
    points_camera: Tensor  # [B, 68, 3]
    ids: Tensor  # [B, 68]


@dataclass(frozen=True)
class Problem:
    """A cost to minimise: Huber's cost of the weighted landmark differences, plus the squared coordinates."""

    basis: FitBasis
    target_px: Tensor  # [B, 68, 2]
    camera: Camera
    inverse_noise: Tensor  # [B, 68], 1 / pixels
    huber: float


def minimise(problem: Problem, state: FitState, steps: int) -> FitState:
    """The state [B] after at most `steps` steps."""
    return descend(
        lambda there: residuals(problem, there),
        lambda there, at: landmark_cost(problem, at) + prior_cost(there),
        lambda there, at, damping: _step(problem, there, at, damping),
        state,
        steps,
    )


def descend(
    residuals_of: Callable[[FitState], Residuals],
    cost_of: Callable[[FitState, Residuals], Tensor],
    step_of: Callable[[FitState, Residuals, Tensor], Tensor],
    state: FitState,
    steps: int,
) -> FitState:
    """Run Levenberg's damped Gauss-Newton; each face accepts a step only if its cost falls.

    A settled face no longer changes, so its result does not depend on the other faces; the loop ends when all
    faces have settled.

    Args:
        residuals_of: Residuals, with their derivatives, of a state.
        cost_of: Cost [B] of a state with its residuals.
        step_of: Step from a state with its residuals, under a damping [B].
        state: First state of the B faces.
        steps: Steps at most.
    """
    damping = torch.full((len(state.coordinates),), _FIRST_DAMPING, dtype=torch.float64)
    at = residuals_of(state)
    cost = cost_of(state, at)
    settled = torch.zeros_like(cost, dtype=torch.bool)
    for _ in range(steps):
        trial = apply_step(state, step_of(state, at, damping))
        trial_at = residuals_of(trial)
        trial_cost = cost_of(trial, trial_at)
        accept = (trial_cost < cost) & ~settled  # False for NaN
        settled |= torch.where(accept, cost - trial_cost < _SETTLED * cost, damping > _STUCK)
        state, at = trial.where(accept, state), trial_at.where(accept, at)
        cost = torch.where(accept, trial_cost, cost)
        damping = torch.where(accept, damping / 5, damping * 10).clamp(1e-9, 1e6)
        if settled.all():
            break
    return state


def apply_step(state: FitState, step: Tensor) -> FitState:
    """The state after a step [B, 6 + Q]: rotation exp(omega) R, translation shifted in units of its depth."""
    omega, shift, change = step[:, :3], step[:, 3:6], step[:, 6:]
    translation = state.translation_m - shift * state.translation_m[:, 2:]
    return FitState(so3_exp(omega) @ state.rotation, translation, state.coordinates + change)


def residuals(problem: Problem, state: FitState) -> Residuals:
    """Residuals of the 68 landmarks; contour landmarks use the closest points of the silhouette."""
    basis, batch = problem.basis, len(problem.target_px)
    head = basis.mean + (state.coordinates @ basis.modes.flatten(0, 1).mT).reshape(batch, -1, 3)
    in_camera = head @ state.rotation.mT + state.translation_m[:, None]
    px = project(in_camera, problem.camera)
    contour_ids = INNER_COUNT + _closest_edge(problem, state, px[:, INNER_COUNT:])
    ids = torch.cat([contour_ids, torch.arange(INNER_COUNT).expand(batch, -1)], 1)
    difference_px = px.gather(1, ids[..., None].expand(-1, -1, 2)) - problem.target_px
    return Residuals(difference_px, in_camera.gather(1, ids[..., None].expand(-1, -1, 3)), ids)


def _closest_edge(problem: Problem, state: FitState, band_px: Tensor) -> Tensor:
    """The band's points [B, 17] on the silhouette that lie closest to the contour landmarks."""
    outward = problem.basis.outward @ state.rotation.mT  # [B, rays, 3]
    rays = outward.shape[1]
    furthest = outermost(band_px.reshape(-1, rays, POINTS_PER_RAY, 2), outward)
    edge = furthest + torch.arange(rays) * POINTS_PER_RAY  # [B, rays]
    edge_px = band_px.gather(1, edge[..., None].expand(-1, -1, 2))
    near = torch.arange(len(CONTOUR))[:, None] * RAYS_PER_LANDMARK + torch.arange(-_WINDOW, _WINDOW + 1)
    near = near.clamp(0, rays - 1)  # [17, window]
    distance = (edge_px[:, near] - problem.target_px[:, : len(CONTOUR), None]).norm(dim=-1)
    closest = near.expand(len(edge), -1, -1).gather(2, distance.argmin(-1, keepdim=True))[..., 0]
    return edge.gather(1, closest)


def total_cost(problem: Problem, state: FitState) -> Tensor:
    """The minimised cost [B]."""
    return landmark_cost(problem, residuals(problem, state)) + prior_cost(state)


def landmark_cost(problem: Problem, at: Residuals) -> Tensor:
    """Huber's cost of the landmarks [B]."""
    distance, huber = at.difference_px.norm(dim=-1) * problem.inverse_noise, problem.huber
    robust = torch.where(distance <= huber, distance**2, huber * (2 * distance - huber))
    return robust.sum(1)


def prior_cost(state: FitState) -> Tensor:
    """The Gaussian priors' cost [B]."""
    return (state.coordinates**2).sum(1)


def _step(problem: Problem, state: FitState, at: Residuals, damping: Tensor) -> Tensor:
    """The damped step [B, 6 + Q] of the iteratively reweighted least squares."""
    normal, gradient = normal_equations(problem, jacobian(problem, state, at), at)
    return damped_step(normal, gradient, state.coordinates, damping)


def jacobian(problem: Problem, state: FitState, at: Residuals) -> Tensor:
    """d(px) / d(omega, shift, coordinates) [B, 68, 2, 6 + Q] at fixed correspondences, see `apply_step`."""
    px_by_camera = pixels_by_points(at.points_camera, problem.camera)
    by_pose = pixels_by_pose(px_by_camera, at.points_camera, state.translation_m)
    px_by_head = px_by_camera @ state.rotation[:, None]
    contour, inner = px_by_head[:, : len(CONTOUR)], px_by_head[:, len(CONTOUR) :]
    modes = problem.basis.modes
    by_contour = contour @ modes[at.ids[:, : len(CONTOUR)]]
    # All faces share the modes of the inner landmarks: one product for each landmark, all faces at once.
    by_inner = (inner.permute(1, 0, 2, 3).flatten(1, 2) @ modes[:INNER_COUNT]).reshape(
        INNER_COUNT, len(inner), 2, modes.shape[-1]
    )
    by_coordinates = torch.cat([by_contour, by_inner.permute(1, 0, 2, 3)], 1)
    return torch.cat([by_pose, by_coordinates], -1)


def pixels_by_points(points_camera: Tensor, camera: Camera) -> Tensor:
    """d(px) / d(point) [..., 2, 3] of points [..., 3]."""
    x, y, z = points_camera.unbind(-1)
    zero, scale = torch.zeros_like(x), camera.focal_px / -z
    rows_u = torch.stack([scale, zero, -scale * x / z], -1)
    rows_v = torch.stack([zero, -scale, scale * y / z], -1)
    return torch.stack([rows_u, rows_v], -2)


def pixels_by_pose(px_by_camera: Tensor, points_camera: Tensor, translation_m: Tensor) -> Tensor:
    """d(px) / d(omega, shift) [B, N, 2, 6] of points [B, N, 3] of heads at translations [B, 3]."""
    turned = points_camera - translation_m[:, None]
    by_rotation = -px_by_camera @ skew_matrix(turned)
    by_translation = px_by_camera * -translation_m[:, None, None, 2:]
    return torch.cat([by_rotation, by_translation], -1)


def normal_equations(problem: Problem, by_parameters: Tensor, at: Residuals) -> tuple[Tensor, Tensor]:
    """The landmarks' normal matrix [B, P, P] and gradient [B, P], reweighted.

    by_parameters [B, 68, 2, P] is the Jacobian.
    """
    distance = at.difference_px.norm(dim=-1) * problem.inverse_noise
    weight = problem.inverse_noise * (problem.huber / distance.clamp(min=problem.huber)).sqrt()  # [B, 68]
    weighted = (by_parameters * weight[..., None, None]).flatten(1, 2)
    difference = (at.difference_px * weight[..., None]).flatten(1, 2)
    return weighted.mT @ weighted, (difference[:, None] @ weighted)[:, 0]


def damped_step(normal: Tensor, gradient: Tensor, coordinates: Tensor, damping: Tensor) -> Tensor:
    """Solve the landmarks' normal equations with the priors added: the step [B, 6 + Q]."""
    prior = torch.ones(normal.shape[-1], dtype=torch.float64)
    prior[:6] = 0
    gradient = gradient.clone()
    gradient[:, 6:] += coordinates
    normal = normal.clone()
    diagonal = normal.diagonal(dim1=1, dim2=2)
    diagonal += prior + damping[:, None] * (diagonal + prior)
    return -torch.cholesky_solve(gradient[..., None], torch.linalg.cholesky(normal))[..., 0]


def weak_perspective(basis: FitBasis, target_px: Tensor, camera: Camera) -> tuple[FitState, Tensor]:
    """Pose the mean by a scaled orthographic fit to the inner ones of the landmarks target_px [B, 68, 2].

    Returns the state and its pixels per metre [B].
    """
    model = basis.mean[:INNER_COUNT]
    image = target_px[:, len(CONTOUR) :] * torch.tensor([1.0, -1.0], dtype=torch.float64)  # y up
    middle = image.mean(1)
    rotation, scale = _orthographic(model.expand(len(image), -1, -1), image)
    depth_m = camera.focal_px / scale
    offset = (middle - torch.tensor([camera.cx_px, -camera.cy_px], dtype=torch.float64)) / scale[:, None]
    translation = torch.cat([offset, -depth_m[:, None]], 1) - rotation @ model.mean(0)
    coordinates = torch.zeros(len(image), basis.modes.shape[-1], dtype=torch.float64)
    return FitState(rotation, translation, coordinates), scale


def pose_from_landmarks(
    points: Tensor, px: Tensor, camera: Camera, rotation: Tensor, translation_m: Tensor
) -> tuple[Tensor, Tensor]:
    """Pose heads of known shape: rotations [B, 3, 3] and translations [B, 3], float64, without derivatives.

    A scaled orthographic fit at the guess's depths (DeMenthon and Davis, *Model-based object pose in 25 lines
    of code*, 1995) precedes a few rounds of orthogonal iteration (Lu, Hager and Mjolsness, *Fast and globally
    convergent pose estimation from video images*, 2000).

    Args:
        points: [B, N, 3] in the head frame, in metres.
        px: Their pixels [B, N, 2].
        camera: The camera of all.
        rotation: First guess [B, 3, 3], head to camera.
        translation_m: First guess [B, 3].
    """
    depth_m = -(points @ rotation.mT + translation_m[:, None])[..., 2:]
    rays = pixel_rays(px, camera)
    rotation, _ = _orthographic(points, rays[..., :2] * depth_m)
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


def _orthographic(points: Tensor, image: Tensor) -> tuple[Tensor, Tensor]:
    """Rotations [B, 3, 3] and scales [B] that bring points [B, N, 3] to positions [B, N, 2], y up."""
    centred, flat = points - points.mean(1, keepdim=True), image - image.mean(1, keepdim=True)
    affine = torch.linalg.lstsq(centred, flat).solution.mT  # [B, 2, 3]
    u, stretch, vh = torch.linalg.svd(affine, full_matrices=False)
    rows = u @ vh
    rotation = torch.cat([rows, torch.linalg.cross(rows[:, :1], rows[:, 1:])], 1)
    return rotation, stretch.mean(-1)


def _closest_rotation(wanted: Tensor, points: Tensor) -> Tensor:
    """Rotations [B, 3, 3] that bring centred points [B, N, 3] closest to centred `wanted` (Kabsch, 1976)."""
    moment = (wanted - wanted.mean(1, keepdim=True)).mT @ (points - points.mean(1, keepdim=True))
    u, _, vh = torch.linalg.svd(moment)
    signs = torch.ones(len(points), 3, dtype=points.dtype)
    signs[:, 2] = torch.det(u @ vh).sign()
    return u @ (signs[..., None] * vh)
