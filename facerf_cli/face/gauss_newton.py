"""Damped Gauss-Newton on the landmarks of N views of B heads, in float64; `face/fit.py` sets up the problem.

A photo is one view of one head, a video many heads with one view each, and a capture one head in many
cameras. Images use the camera `PLANE`.

Contour landmarks slide along the jaw: every step compares each of them with the closest point of the mesh's
current silhouette (paper, 'Landmark loss').
"""

from dataclasses import dataclass, fields, replace
from typing import Self

import torch
import torch.nn.functional as F
from torch import Tensor

from facerf_cli.face.topology import CONTOUR, POINTS_PER_RAY, RAYS_PER_LANDMARK, outermost
from facerf_cli.raster.camera import PLANE, project, skew_matrix, so3_exp

_PITCHES_DEG = (0.0, 10.0, -10.0)  # of the starts, added to the pitch from `weak_perspective`
_FIRST_DAMPING = 1e-3
_CONVERGED = 1e-7  # a head has converged when a step lowers its cost by less than this fraction,
_STUCK = 1e3  # or when no step lowers its cost at this damping
_WINDOW = 2 * RAYS_PER_LANDMARK  # a contour landmark slides by at most two landmarks along the jaw


class _Rows:
    """Base of dataclasses of tensors with a common first axis."""

    def where(self, accept: Tensor, other: Self) -> Self:
        """Select these rows where accept [rows] is true, and the other's rows elsewhere."""
        pairs = ((getattr(self, field.name), getattr(other, field.name)) for field in fields(self))  # type: ignore[arg-type]
        return type(self)(*(torch.where(accept.reshape(-1, *[1] * (a.ndim - 1)), a, b) for a, b in pairs))

    def rows(self, index: Tensor) -> Self:
        """Select rows by a mask, or by index, possibly repeatedly."""
        return type(self)(*(getattr(self, field.name)[index] for field in fields(self)))  # type: ignore[arg-type]

    def with_rows(self, index: Tensor, rows: Self) -> Self:
        """Return a copy in which `rows` replace those at `index`."""
        pairs = ((getattr(self, field.name), getattr(rows, field.name)) for field in fields(self))  # type: ignore[arg-type]
        return type(self)(*(a.index_copy(0, index, b) for a, b in pairs))


@dataclass(frozen=True)
class FitBasis:
    """The model at the P points that a fit uses: the inner landmarks, then the contour's band ray by ray.

    The fit works in Q coordinates with standard normal priors: the whitened coefficients in an orthonormal
    basis, without the directions that move none of these points.
    """

    mean: Tensor  # [P, 3]
    modes: Tensor  # [P, 3, Q]
    spread: Tensor  # [K, Q], coordinates to coefficients, identity then expression
    outward: Tensor  # [rays, 3], head frame

    @property
    def inner(self) -> int:
        """Number of inner landmarks."""
        return len(self.mean) - len(self.outward) * POINTS_PER_RAY

    @property
    def middle(self) -> Tensor:
        """Mean [3] of the inner landmarks, head frame."""
        return self.mean[: self.inner].mean(0)


@dataclass(frozen=True)
class FitState(_Rows):
    """Pose and shape of B heads, in a space common to the views of each head."""

    rotation: Tensor  # [B, 3, 3], from the head frame
    translation_m: Tensor  # [B, 3]
    coordinates: Tensor  # [B, Q], see FitBasis


@dataclass(frozen=True)
class Views(_Rows):
    """N images with L landmarks each, contour first, and the poses of their cameras."""

    plane: Tensor  # [N, L, 2], the landmarks in the image
    trust: Tensor  # [N, L] in 0..1
    head: Tensor  # [N], index of the view's head
    rotation: Tensor  # [N, 3, 3], from the common space to the camera's
    translation_m: Tensor  # [N, 3]

    def poses(self, rotation: Tensor, translation_m: Tensor) -> tuple[Tensor, Tensor]:
        """Transform poses of heads [B] to camera space: rotations [N, 3, 3] and translations [N, 3]."""
        shift_m = (self.rotation @ translation_m[self.head, :, None])[..., 0] + self.translation_m
        return self.rotation @ rotation[self.head], shift_m


@dataclass(frozen=True)
class Residuals(_Rows):
    """Landmark differences in the image, and the corresponding points of the basis."""

    difference: Tensor  # [N, L, 2]
    points_camera: Tensor  # [N, L, 3]
    ids: Tensor  # [N, L]
    rotation: Tensor  # [N, 3, 3], head to camera
    translation_m: Tensor  # [N, 3]


@dataclass(frozen=True)
class Problem:
    """The minimised cost: Huber's cost of the weighted landmark differences, plus the squared coordinates."""

    basis: FitBasis
    views: Views
    inverse_noise: Tensor  # [N, L]
    huber: float

    def with_views(self, index: Tensor, head: Tensor) -> "Problem":
        """Return the problem of the views at `index`, possibly repeated, assigned to new heads."""
        views = replace(self.views.rows(index), head=head)
        return replace(self, views=views, inverse_noise=self.inverse_noise[index])


def minimise(problem: Problem, state: FitState, steps: int) -> tuple[FitState, Tensor]:
    """Run at most `steps` steps of Levenberg's damped Gauss-Newton; return the heads and their costs [B].

    Each head accepts a step only if its cost falls. A converged head takes no more steps, so its result does
    not depend on the other heads.
    """
    damping = torch.full((len(state.coordinates),), _FIRST_DAMPING, dtype=torch.float64)
    at = residuals(problem, state)
    cost = cost_of(problem, state, at)
    result, costs, active = state, cost, torch.arange(len(cost))
    for _ in range(steps):
        trial = apply_step(state, _step(problem, state, at, damping))
        trial_at = residuals(problem, trial)
        trial_cost = cost_of(problem, trial, trial_at)
        accept = trial_cost < cost  # False for NaN
        continues = torch.where(accept, cost - trial_cost >= _CONVERGED * cost, damping <= _STUCK)
        state, at = trial.where(accept, state), trial_at.where(accept[problem.views.head], at)
        cost = torch.where(accept, trial_cost, cost)
        result, costs = result.with_rows(active, state), costs.index_copy(0, active, cost)
        if not continues.any():
            break
        damping = torch.where(accept, damping / 5, damping * 10).clamp(1e-9, 1e6)
        if not continues.all():
            views, new_index = continues[problem.views.head], continues.cumsum(0) - 1
            problem = problem.with_views(views, new_index[problem.views.head[views]])
            state, at = state.rows(continues), at.rows(views)
            cost, damping, active = cost[continues], damping[continues], active[continues]
    return result, costs


def apply_step(state: FitState, step: Tensor) -> FitState:
    """Apply a step [B, 6 + Q]: rotate by exp(omega), then add to translation and coordinates."""
    omega, shift_m, change = step[:, :3], step[:, 3:6], step[:, 6:]
    return FitState(
        so3_exp(omega) @ state.rotation, state.translation_m + shift_m, state.coordinates + change
    )


def residuals(problem: Problem, state: FitState) -> Residuals:
    """Compute the landmarks' residuals; contour landmarks use the closest points of the silhouette."""
    basis, views = problem.basis, problem.views
    rotation, translation_m = views.poses(state.rotation, state.translation_m)
    offset = state.coordinates @ basis.modes.flatten(0, 1).mT
    heads = basis.mean + offset.reshape(len(offset), -1, 3)
    in_camera = heads[views.head] @ rotation.mT + translation_m[:, None]
    plane = project(in_camera, PLANE)
    ids = torch.arange(basis.inner).expand(len(plane), -1)
    if len(basis.outward):
        edge = _closest_edge(views, basis.outward @ rotation.mT, plane[:, basis.inner :])
        ids = torch.cat([basis.inner + edge, ids], 1)
    difference = plane.gather(1, ids[..., None].expand(-1, -1, 2)) - views.plane
    points = in_camera.gather(1, ids[..., None].expand(-1, -1, 3))
    return Residuals(difference, points, ids, rotation, translation_m)


def _closest_edge(views: Views, outward: Tensor, band: Tensor) -> Tensor:
    """Return the band's points [N, 17] on the silhouette that lie closest to the contour landmarks.

    outward [N, rays, 3] are the rays' directions in camera space, band [N, rays x points, 2] their points.
    """
    rays = outward.shape[1]
    furthest = outermost(band.reshape(-1, rays, POINTS_PER_RAY, 2), outward)
    edge = furthest + torch.arange(rays) * POINTS_PER_RAY  # [N, rays]
    edge_plane = band.gather(1, edge[..., None].expand(-1, -1, 2))
    near = torch.arange(len(CONTOUR))[:, None] * RAYS_PER_LANDMARK + torch.arange(-_WINDOW, _WINDOW + 1)
    near = near.clamp(0, rays - 1)  # [17, window]
    distance = (edge_plane[:, near] - views.plane[:, : len(CONTOUR), None]).norm(dim=-1)
    closest = near.expand(len(edge), -1, -1).gather(2, distance.argmin(-1, keepdim=True))[..., 0]
    return edge.gather(1, closest)


def cost_of(problem: Problem, state: FitState, at: Residuals) -> Tensor:
    """Compute the minimised cost [B] of heads with these residuals."""
    distance, huber = at.difference.norm(dim=-1) * problem.inverse_noise, problem.huber
    robust = torch.where(distance <= huber, distance**2, huber * (2 * distance - huber))
    return (state.coordinates**2).sum(1).index_add(0, problem.views.head, robust.sum(1))


def _step(problem: Problem, state: FitState, at: Residuals, damping: Tensor) -> Tensor:
    """Compute the damped step [B, 6 + Q] of the iteratively reweighted least squares."""
    distance = at.difference.norm(dim=-1) * problem.inverse_noise
    weight = problem.inverse_noise * (problem.huber / distance.clamp(min=problem.huber)).sqrt()  # [N, L]
    weighted = (jacobian(problem, at) * weight[..., None, None]).flatten(1, 2)
    difference = (at.difference * weight[..., None]).flatten(1, 2)
    head, size = problem.views.head, weighted.shape[-1]
    normal = torch.zeros(len(damping), size, size, dtype=weighted.dtype)
    normal.index_add_(0, head, weighted.mT @ weighted)
    gradient = F.pad(state.coordinates, (6, 0)).index_add(0, head, (difference[:, None] @ weighted)[:, 0])
    prior = torch.ones(size, dtype=weighted.dtype)
    prior[:6] = 0
    diagonal = normal.diagonal(dim1=1, dim2=2)
    diagonal += prior + damping[:, None] * (diagonal + prior)
    return -torch.cholesky_solve(gradient[..., None], torch.linalg.cholesky(normal))[..., 0]


def jacobian(problem: Problem, at: Residuals) -> Tensor:
    """Compute d(image) / d(step) [N, L, 2, 6 + Q] at fixed correspondences; see `apply_step`."""
    views, modes, inner = problem.views, problem.basis.modes, problem.basis.inner
    by_camera = _image_by_points(at.points_camera)
    by_omega = -by_camera @ skew_matrix(at.points_camera - at.translation_m[:, None])
    by_pose = torch.stack([by_omega, by_camera], -2).flatten(1, 3) @ views.rotation  # [N, L x 2 x 2, 3]
    by_head = (by_camera.flatten(1, 2) @ at.rotation).view_as(by_camera)
    contour, inside = by_head[:, :-inner], by_head[:, -inner:]
    by_contour = contour @ modes[at.ids[:, :-inner]]
    # All views have the same modes at an inner landmark: one product per landmark serves all views.
    by_inside = inside.permute(1, 0, 2, 3).flatten(1, 2) @ modes[:inner]
    by_inside = by_inside.reshape(inner, len(inside), 2, modes.shape[-1])
    by_coordinates = torch.cat([by_contour, by_inside.permute(1, 0, 2, 3)], 1)
    return torch.cat([by_pose.reshape(*by_camera.shape[:3], 6), by_coordinates], -1)


def _image_by_points(points_camera: Tensor) -> Tensor:
    """Compute d(image) / d(point) [..., 2, 3] at points [..., 3]."""
    x, y, z = points_camera.unbind(-1)
    zero, scale = torch.zeros_like(x), -1 / z
    rows_u = torch.stack([scale, zero, -scale * x / z], -1)
    rows_v = torch.stack([zero, -scale, scale * y / z], -1)
    return torch.stack([rows_u, rows_v], -2)


def weak_perspective(basis: FitBasis, views: Views) -> tuple[FitState, Tensor]:
    """Pose the mean face with a scaled orthographic fit to the inner landmarks of each view.

    Returns N heads, each in the common space of its view, and their scales [N] in the images, 1 / m.
    """
    points = basis.mean[: basis.inner]
    image = views.plane[:, -basis.inner :] * torch.tensor([1.0, -1.0], dtype=torch.float64)  # y up
    middle = image.mean(1)
    centred = (points - basis.middle).expand(len(image), -1, -1)
    affine = torch.linalg.lstsq(centred, image - middle[:, None]).solution.mT  # [N, 2, 3]
    u, stretch, vh = torch.linalg.svd(affine, full_matrices=False)
    across, scale = u @ vh, stretch.mean(-1)
    rotation = torch.cat([across, torch.linalg.cross(across[:, :1], across[:, 1:])], 1)
    shift_m = torch.cat([middle, -torch.ones_like(middle[:, :1])], 1) / scale[:, None]
    shift_m = shift_m - rotation @ basis.middle - views.translation_m
    translation_m = (views.rotation.mT @ shift_m[..., None])[..., 0]
    coordinates = torch.zeros(len(image), basis.modes.shape[-1], dtype=torch.float64)
    return FitState(views.rotation.mT @ rotation, translation_m, coordinates), scale


def least_from_pitches(problem: Problem, by_view: FitState, steps: int) -> FitState:
    """Fit B heads from the starts of `_PITCHES_DEG` at once, and return the least cost of each head.

    Args:
        problem: The problem of N views.
        by_view: Each view's own estimate of its head [N]; each head starts from the best one of its views.
        steps: Largest number of steps.
    """
    first = _best_of_views(problem, by_view)
    starts, count = len(_PITCHES_DEG), len(first.rotation)
    each, head = torch.arange(count), problem.views.head
    many = problem.with_views(
        torch.arange(len(head)).repeat(starts), (head + count * torch.arange(starts)[:, None]).flatten()
    )
    axis_angle = torch.tensor([[pitch, 0.0, 0.0] for pitch in _PITCHES_DEG], dtype=torch.float64)
    pitched = so3_exp(axis_angle.deg2rad())[:, None]  # [S, 1, 3, 3]
    start = first.rows(each.repeat(starts))  # [S x B]
    rotation = (first.rotation @ pitched).flatten(0, 1)
    translation_m = start.translation_m + (start.rotation - rotation) @ problem.basis.middle
    state, cost = minimise(many, replace(start, rotation=rotation, translation_m=translation_m), steps)
    return state.rows(cost.reshape(starts, count).argmin(0) * count + each)


def _best_of_views(problem: Problem, by_view: FitState) -> FitState:
    """Choose for each head [B] the estimate, among its views' [N], with the least cost over its views."""
    head = problem.views.head
    candidate, view = (head[:, None] == head).nonzero().unbind(1)
    trial = problem.with_views(view, candidate)
    costs = cost_of(trial, by_view, residuals(trial, by_view)).nan_to_num(nan=torch.inf)
    heads = torch.arange(int(head.max()) + 1)
    return by_view.rows(torch.where(head == heads[:, None], costs, torch.inf).argmin(1))
