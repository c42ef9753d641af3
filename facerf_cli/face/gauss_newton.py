"""Damped Gauss-Newton on the landmarks of N views of B heads, in float64; `face/fit.py` sets it up.

A photo is one view of one head, a film many heads of one view each, a capture one head in many cameras. All
images are those of `PLANE`.

Contour landmarks slide along the jaw: each one is compared with the closest point of the mesh's silhouette,
which is found again at every step (paper, 'Landmark loss').
"""

from dataclasses import dataclass, fields, replace
from typing import Self

import torch
import torch.nn.functional as F
from torch import Tensor

from facerf_cli.face.topology import CONTOUR, POINTS_PER_RAY, RAYS_PER_LANDMARK, outermost
from facerf_cli.raster.camera import PLANE, project, skew_matrix, so3_exp

_PITCHES_DEG = (0.0, 10.0, -10.0)  # of the starts, added to the pitch of the mean at the landmarks
_FIRST_DAMPING = 1e-3
_SETTLED = 1e-7  # a head has settled when a step lowers its cost by less than this share
_STUCK = 1e3  # or when no step lowers its cost at this damping
_WINDOW = 2 * RAYS_PER_LANDMARK  # a contour landmark slides by at most two landmarks along the jaw


class _Rows:
    """Dataclasses of tensors with one first axis."""

    def where(self, accept: Tensor, other: Self) -> Self:
        """Select these rows where accept [rows] is true, else the other's."""
        pairs = ((getattr(self, one.name), getattr(other, one.name)) for one in fields(self))  # type: ignore[arg-type]
        return type(self)(*(torch.where(accept.reshape(-1, *[1] * (a.ndim - 1)), a, b) for a, b in pairs))

    def rows(self, index: Tensor) -> Self:
        """Select rows by their numbers, some perhaps repeatedly, or by a mask."""
        return type(self)(*(getattr(self, one.name)[index] for one in fields(self)))  # type: ignore[arg-type]

    def put(self, index: Tensor, rows: Self) -> Self:
        """Replace the rows of these numbers."""
        pairs = ((getattr(self, one.name), getattr(rows, one.name)) for one in fields(self))  # type: ignore[arg-type]
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
        """The number of inner landmarks."""
        return len(self.mean) - len(self.outward) * POINTS_PER_RAY

    @property
    def middle(self) -> Tensor:
        """The mean [3] of the inner landmarks, head frame."""
        return self.mean[: self.inner].mean(0)


@dataclass(frozen=True)
class FitState(_Rows):
    """Pose and shape of B heads, in the space that the views of each head share."""

    rotation: Tensor  # [B, 3, 3], from the head frame
    translation_m: Tensor  # [B, 3]
    coordinates: Tensor  # [B, Q], see FitBasis


@dataclass(frozen=True)
class Views(_Rows):
    """N images with L landmarks each, contour first, and the poses of their cameras."""

    plane: Tensor  # [N, L, 2], the landmarks in the image
    trust: Tensor  # [N, L] in 0..1
    head: Tensor  # [N], whose landmarks they are
    turn: Tensor  # [N, 3, 3], from the head's space to the camera's
    shift_m: Tensor  # [N, 3]

    def poses(self, rotation: Tensor, translation_m: Tensor) -> tuple[Tensor, Tensor]:
        """Rotations [N, 3, 3] and translations [N, 3] of heads [B] in the space of each view's camera."""
        place = (self.turn @ translation_m[self.head, :, None])[..., 0] + self.shift_m
        return self.turn @ rotation[self.head], place


@dataclass(frozen=True)
class Residuals(_Rows):
    """Landmark differences in the image, and the points of the basis where they are taken."""

    difference: Tensor  # [N, L, 2]
    points_camera: Tensor  # [N, L, 3]
    ids: Tensor  # [N, L]
    rotation: Tensor  # [N, 3, 3], head to camera
    place: Tensor  # [N, 3]


@dataclass(frozen=True)
class Problem:
    """A cost to minimise: Huber's cost of the weighted landmark differences, plus the squared coordinates."""

    basis: FitBasis
    views: Views
    inverse_noise: Tensor  # [N, L]
    huber: float

    def of_views(self, index: Tensor, head: Tensor) -> "Problem":
        """The problem of some views, perhaps repeated, of these heads."""
        views = replace(self.views.rows(index), head=head)
        return replace(self, views=views, inverse_noise=self.inverse_noise[index])


def minimise(problem: Problem, state: FitState, steps: int) -> tuple[FitState, Tensor]:
    """Run at most `steps` steps of Levenberg's damped Gauss-Newton: the heads and their costs [B].

    Each head accepts a step only if its cost falls. A settled head takes no more steps, so its result does
    not depend on the other heads.
    """
    damping = torch.full((len(state.coordinates),), _FIRST_DAMPING, dtype=torch.float64)
    at = residuals(problem, state)
    cost = cost_of(problem, state, at)
    found, costs, moving = state, cost, torch.arange(len(cost))
    for _ in range(steps):
        trial = apply_step(state, _step(problem, state, at, damping))
        trial_at = residuals(problem, trial)
        trial_cost = cost_of(problem, trial, trial_at)
        accept = trial_cost < cost  # False for NaN
        on = torch.where(accept, cost - trial_cost >= _SETTLED * cost, damping <= _STUCK)
        state, at = trial.where(accept, state), trial_at.where(accept[problem.views.head], at)
        cost = torch.where(accept, trial_cost, cost)
        found, costs = found.put(moving, state), costs.index_copy(0, moving, cost)
        if not on.any():
            break
        damping = torch.where(accept, damping / 5, damping * 10).clamp(1e-9, 1e6)
        if not on.all():
            seen, number = on[problem.views.head], on.cumsum(0) - 1
            problem = problem.of_views(seen, number[problem.views.head[seen]])
            state, at, cost, damping, moving = (
                state.rows(on),
                at.rows(seen),
                cost[on],
                damping[on],
                moving[on],
            )
    return found, costs


def apply_step(state: FitState, step: Tensor) -> FitState:
    """The state after a step [B, 6 + Q]: rotation exp(omega) R, then translation and coordinates added."""
    omega, shift_m, change = step[:, :3], step[:, 3:6], step[:, 6:]
    return FitState(
        so3_exp(omega) @ state.rotation, state.translation_m + shift_m, state.coordinates + change
    )


def residuals(problem: Problem, state: FitState) -> Residuals:
    """Residuals of the landmarks; contour landmarks use the closest points of the silhouette."""
    basis, views = problem.basis, problem.views
    rotation, place = views.poses(state.rotation, state.translation_m)
    offset = state.coordinates @ basis.modes.flatten(0, 1).mT
    heads = basis.mean + offset.reshape(len(offset), -1, 3)
    in_camera = heads[views.head] @ rotation.mT + place[:, None]
    plane = project(in_camera, PLANE)
    ids = torch.arange(basis.inner).expand(len(plane), -1)
    if len(basis.outward):
        edge = _closest_edge(views, basis.outward @ rotation.mT, plane[:, basis.inner :])
        ids = torch.cat([basis.inner + edge, ids], 1)
    difference = plane.gather(1, ids[..., None].expand(-1, -1, 2)) - views.plane
    points = in_camera.gather(1, ids[..., None].expand(-1, -1, 3))
    return Residuals(difference, points, ids, rotation, place)


def _closest_edge(views: Views, outward: Tensor, band: Tensor) -> Tensor:
    """The band's points [N, 17] on the silhouette that lie closest to the contour landmarks.

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
    """The minimised cost [B] of heads with these residuals."""
    distance, huber = at.difference.norm(dim=-1) * problem.inverse_noise, problem.huber
    robust = torch.where(distance <= huber, distance**2, huber * (2 * distance - huber))
    return (state.coordinates**2).sum(1).index_add(0, problem.views.head, robust.sum(1))


def _step(problem: Problem, state: FitState, at: Residuals, damping: Tensor) -> Tensor:
    """The damped step [B, 6 + Q] of the iteratively reweighted least squares."""
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
    """d(image) / d(omega, shift, coordinates) [N, L, 2, 6 + Q] at fixed correspondences, see `apply_step`."""
    views, modes, inner = problem.views, problem.basis.modes, problem.basis.inner
    by_camera = _image_by_points(at.points_camera)
    by_omega = -by_camera @ skew_matrix(at.points_camera - at.place[:, None])
    by_pose = torch.stack([by_omega, by_camera], -2).flatten(1, 3) @ views.turn  # [N, L x 2 x 2, 3]
    by_head = (by_camera.flatten(1, 2) @ at.rotation).view_as(by_camera)
    contour, inside = by_head[:, :-inner], by_head[:, -inner:]
    by_contour = contour @ modes[at.ids[:, :-inner]]
    # All views share the modes of the inner landmarks: one product for each landmark, all views at once.
    by_inside = inside.permute(1, 0, 2, 3).flatten(1, 2) @ modes[:inner]
    by_inside = by_inside.reshape(inner, len(inside), 2, modes.shape[-1])
    by_coordinates = torch.cat([by_contour, by_inside.permute(1, 0, 2, 3)], 1)
    return torch.cat([by_pose.reshape(*by_camera.shape[:3], 6), by_coordinates], -1)


def _image_by_points(points_camera: Tensor) -> Tensor:
    """d(image) / d(point) [..., 2, 3] of points [..., 3]."""
    x, y, z = points_camera.unbind(-1)
    zero, scale = torch.zeros_like(x), -1 / z
    rows_u = torch.stack([scale, zero, -scale * x / z], -1)
    rows_v = torch.stack([zero, -scale, scale * y / z], -1)
    return torch.stack([rows_u, rows_v], -2)


def weak_perspective(basis: FitBasis, views: Views) -> tuple[FitState, Tensor]:
    """Pose the mean by a scaled orthographic fit to the inner landmarks of each view.

    Returns N heads, each in the space that the view shares with others, and their scales [N] in the images,
    1 / m.
    """
    points = basis.mean[: basis.inner]
    image = views.plane[:, -basis.inner :] * torch.tensor([1.0, -1.0], dtype=torch.float64)  # y up
    middle = image.mean(1)
    centred = (points - basis.middle).expand(len(image), -1, -1)
    affine = torch.linalg.lstsq(centred, image - middle[:, None]).solution.mT  # [N, 2, 3]
    u, stretch, vh = torch.linalg.svd(affine, full_matrices=False)
    across, scale = u @ vh, stretch.mean(-1)
    rotation = torch.cat([across, torch.linalg.cross(across[:, :1], across[:, 1:])], 1)
    place = torch.cat([middle, -torch.ones_like(middle[:, :1])], 1) / scale[:, None]
    place = place - rotation @ basis.middle - views.shift_m
    coordinates = torch.zeros(len(image), basis.modes.shape[-1], dtype=torch.float64)
    return FitState(views.turn.mT @ rotation, (views.turn.mT @ place[..., None])[..., 0], coordinates), scale


def least_from_pitches(problem: Problem, alone: FitState, steps: int) -> FitState:
    """Fit B heads from `_PITCHES_DEG` at once; the least cost of each head wins.

    Args:
        problem: The problem of N views.
        alone: Where each view alone places its head [N]; the one of least cost over a head's views starts it.
        steps: Steps at most.
    """
    first = _best_of_views(problem, alone)
    starts, count = len(_PITCHES_DEG), len(first.rotation)
    each, head = torch.arange(count), problem.views.head
    many = problem.of_views(
        torch.arange(len(head)).repeat(starts), (head + count * torch.arange(starts)[:, None]).flatten()
    )
    about = torch.tensor([[pitch, 0.0, 0.0] for pitch in _PITCHES_DEG], dtype=torch.float64)
    turn = so3_exp(about.deg2rad())[:, None]  # [S, 1, 3, 3]
    begin = first.rows(each.repeat(starts))  # [S x B]
    rotation = (first.rotation @ turn).flatten(0, 1)
    place = begin.translation_m + (begin.rotation - rotation) @ problem.basis.middle
    state, cost = minimise(many, replace(begin, rotation=rotation, translation_m=place), steps)
    return state.rows(cost.reshape(starts, count).argmin(0) * count + each)


def _best_of_views(problem: Problem, alone: FitState) -> FitState:
    """Of the heads [N] that each view alone places, those [B] of the least costs over all views of a head."""
    head = problem.views.head
    candidate, view = (head[:, None] == head).nonzero().unbind(1)
    tried = problem.of_views(view, candidate)
    costs = cost_of(tried, alone, residuals(tried, alone)).nan_to_num(nan=torch.inf)
    heads = torch.arange(int(head.max()) + 1)
    return alone.rows(torch.where(head == heads[:, None], costs, torch.inf).argmin(1))
