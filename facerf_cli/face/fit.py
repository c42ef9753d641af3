"""The face model fitted to 68 landmarks: damped Gauss-Newton with strong priors (paper, 'Landmark loss').

The camera is fixed; pose (rotation, translation), identity alpha and expression beta are what varies. Contour
landmarks slide: each is held to the closest point of the mesh's silhouette near the jaw, found anew at every
step. Everything is batched over B faces in float64.
"""

from dataclasses import dataclass, fields
from functools import lru_cache

import numpy as np
import torch
from torch import Tensor

from facerf_cli.face.morphable import MorphableModel
from facerf_cli.face.topology import CONTOUR, LANDMARK_UV, LANDMARKS_M, OUTER_EYE_CORNERS, locate
from facerf_cli.raster.camera import Camera, project, skew_matrix, so3_exp

_INNER = slice(len(CONTOUR), 68)
_IOD_M = float(np.linalg.norm(np.subtract(*LANDMARKS_M[list(OUTER_EYE_CORNERS)])))
_RAYS_PER_LANDMARK, _POINTS_PER_RAY = 8, 10
_BAND = (0.6, 1.0)  # from the nose (0) to the jaw line (1): where the silhouette may wander
_WINDOW = 2 * _RAYS_PER_LANDMARK  # a contour landmark slides at most two landmarks' way along the jaw


_INVISIBLE_M = 1e-4  # a direction of shape that moves no landmark further at one deviation is left out


@dataclass(frozen=True)
class FitSettings:
    """One setting for all pictures: noise as a share of the inter-ocular distance, priors as deviations."""

    noise_inner: float = 0.03
    noise_contour: float = 0.08
    huber: float = 2.0  # residuals beyond this many noise deviations count linearly
    identity_std: float = 0.3
    expression_std: float = 0.7
    steps: int = 20
    damping: float = 1e-3


@dataclass(frozen=True)
class FitBatch:
    """Fits of B faces, float64: rotation [B, 3, 3] (head to camera), translation_m [B, 3], alpha, beta."""

    rotation: Tensor
    translation_m: Tensor
    alpha: Tensor
    beta: Tensor
    error_iod: Tensor  # [B] mean distance of the 68 over the distance of the outer eye corners

    def vertices_camera(self, model: MorphableModel) -> Tensor:
        """The mesh in camera space [B, V, 3], float32."""
        vertices = model.vertices(self.alpha.float(), self.beta.float())
        return vertices @ self.rotation.float().mT + self.translation_m.float()[:, None]


@dataclass(frozen=True)
class _Basis:
    """The model at the points that a fit may use: the inner landmarks first, then the contour's band.

    The fit works in Q coordinates with standard normal priors, an orthonormal turn of the whitened coefficients
    that leaves out what moves none of these points.
    """

    mean: Tensor  # [N, 3]
    modes: Tensor  # [N, 3, Q]
    spread: Tensor  # [K, Q], coordinates to coefficients, identity then expression
    outward: Tensor  # [rays, 3], head frame


@dataclass(frozen=True)
class _State:
    """Pose and shape of B faces."""

    rotation: Tensor  # [B, 3, 3]
    translation_m: Tensor  # [B, 3]
    coordinates: Tensor  # [B, Q], see _Basis

    def where(self, accept: Tensor, other: "_State") -> "_State":
        """This state where accept [B] holds, else the other."""
        pairs = ((getattr(self, field.name), getattr(other, field.name)) for field in fields(self))
        return _State(*(torch.where(accept.reshape(-1, *[1] * (a.ndim - 1)), a, b) for a, b in pairs))


@dataclass(frozen=True)
class _Residuals:
    """Landmark differences in pixels [B, 68, 2] and the points of the basis (ids [B, 68]) that they are of."""

    difference_px: Tensor
    points_camera: Tensor  # [B, 68, 3]
    ids: Tensor


def fit_batch(
    model: MorphableModel,
    landmarks_px: Tensor,
    camera: Camera,
    settings: FitSettings = FitSettings(),
    trust: Tensor | None = None,
) -> FitBatch:
    """Fit B faces to landmarks [B, 68, 2] in the camera's pixels; trust [B, 68] in 0..1 weighs each landmark."""
    target_px = landmarks_px.double()
    trust = torch.ones(target_px.shape[:2], dtype=torch.float64) if trust is None else trust.double()
    basis = _basis(model, settings)
    state, scale = _weak_perspective(basis, target_px, camera)
    noise_px = torch.full((68,), settings.noise_inner, dtype=torch.float64)
    noise_px[list(CONTOUR)] = settings.noise_contour
    noise_px = noise_px * (_IOD_M * scale)[:, None]  # [B, 68]
    state = _levenberg(basis, state, target_px, camera, trust.sqrt() / noise_px, settings)
    distance_px = _residuals(basis, state, target_px, camera).difference_px.norm(dim=-1)
    error = (distance_px * trust).sum(1) / trust.sum(1) / _iod_px(target_px)
    coefficients = state.coordinates @ basis.spread.mT
    alpha, beta = coefficients.split([len(model.identity), len(model.expression)], dim=1)
    return FitBatch(state.rotation, state.translation_m, alpha, beta, error)


def _iod_px(landmarks_px: Tensor) -> Tensor:
    left, right = OUTER_EYE_CORNERS
    return (landmarks_px[:, left] - landmarks_px[:, right]).norm(dim=-1)


@lru_cache(maxsize=4)
def _basis(model: MorphableModel, settings: FitSettings) -> _Basis:
    rays = (len(CONTOUR) - 1) * _RAYS_PER_LANDMARK + 1
    along = np.arange(rays) / _RAYS_PER_LANDMARK
    contour = LANDMARK_UV[list(CONTOUR)]
    ends = np.stack([np.interp(along, CONTOUR, contour[:, axis]) for axis in (0, 1)], -1)
    centre = np.array([0.5, LANDMARK_UV[[28, 33], 1].mean()])
    share = np.linspace(*_BAND, _POINTS_PER_RAY)[:, None]
    band = centre + share * (ends - centre)[:, None]  # [rays, points, 2]
    corners, weights = locate(np.concatenate([LANDMARK_UV[_INNER], band.reshape(-1, 2)]))
    modes, spread = _turned(model, settings, corners, weights.double())
    mean = (model.mean[corners].double() * weights[..., None].double()).sum(1)
    ends_m = mean[68 - len(CONTOUR) :].reshape(rays, _POINTS_PER_RAY, 3)[:, -1]
    outward = (ends_m - mean[[28 - len(CONTOUR), 33 - len(CONTOUR)]].mean(0)) * torch.tensor([1.0, 1.0, 0.0])
    return _Basis(mean, modes, spread, outward / outward.norm(dim=-1, keepdim=True))


def _turned(
    model: MorphableModel, settings: FitSettings, corners: Tensor, weights: Tensor
) -> tuple[Tensor, Tensor]:
    """The modes [N, 3, Q] at N points of the mesh and the spread [K, Q] of their coordinates."""
    modes = torch.cat([model.identity[:, corners], model.expression[:, corners]]).double()  # [K, N, 3, 3]
    stds = torch.full((len(modes),), settings.expression_std, dtype=torch.float64)
    stds[: len(model.identity)] = settings.identity_std
    whitened = torch.einsum("k,nc,kncx->nxk", stds, weights, modes)
    turn = torch.linalg.svd(whitened.flatten(0, 1), full_matrices=False).Vh.mT
    turned = whitened @ turn
    visible = turned.norm(dim=1).amax(0) > _INVISIBLE_M
    return turned[..., visible], stds[:, None] * turn[:, visible]


def _weak_perspective(basis: _Basis, target_px: Tensor, camera: Camera) -> tuple[_State, Tensor]:
    """The mean's pose from a scaled orthographic fit to the inner landmarks, and its pixels per metre [B]."""
    model = basis.mean[: 68 - len(CONTOUR)]
    picture = target_px[:, _INNER] * torch.tensor([1.0, -1.0], dtype=torch.float64)  # y up
    centred = model - model.mean(0)
    middle = picture.mean(1)
    affine = torch.linalg.lstsq(centred.expand(len(picture), -1, -1), picture - middle[:, None]).solution.mT
    u, stretch, vh = torch.linalg.svd(affine, full_matrices=False)  # affine [B, 2, 3]
    scale = stretch.mean(-1)
    rows = u @ vh
    rotation = torch.cat([rows, torch.linalg.cross(rows[:, :1], rows[:, 1:])], 1)
    depth_m = camera.focal_px / scale
    offset = (middle - torch.tensor([camera.cx_px, -camera.cy_px], dtype=torch.float64)) / scale[:, None]
    translation = torch.cat([offset, -depth_m[:, None]], 1) - rotation @ model.mean(0)
    return _State(rotation, translation, torch.zeros(len(picture), basis.modes.shape[-1]).double()), scale


def _residuals(basis: _Basis, state: _State, target_px: Tensor, camera: Camera) -> _Residuals:
    """Where the 68 landmarks lie on the mesh now, the contour at the closest points of its silhouette."""
    batch, inner, rays = len(target_px), 68 - len(CONTOUR), len(basis.outward)
    head = basis.mean + (state.coordinates @ basis.modes.flatten(0, 1).mT).unflatten(1, (-1, 3))
    in_camera = head @ state.rotation.mT + state.translation_m[:, None]
    px = project(in_camera, camera)
    outward = basis.outward @ state.rotation.mT  # [B, rays, 3]
    band_px = px[:, inner:].unflatten(1, (rays, _POINTS_PER_RAY))
    reach = band_px[..., 0] * outward[..., None, 0] - band_px[..., 1] * outward[..., None, 1]
    edge = reach.argmax(-1) + torch.arange(rays) * _POINTS_PER_RAY  # [B, rays] the silhouette on each ray
    edge_px = band_px.flatten(1, 2).gather(1, edge[..., None].expand(-1, -1, 2))
    near = torch.arange(len(CONTOUR))[:, None] * _RAYS_PER_LANDMARK + torch.arange(-_WINDOW, _WINDOW + 1)
    near = near.clamp(0, rays - 1)  # [17, window]
    distance = (edge_px[:, near] - target_px[:, : len(CONTOUR), None]).norm(dim=-1)
    closest = near.expand(batch, -1, -1).gather(2, distance.argmin(-1, keepdim=True))[..., 0]  # [B, 17] rays
    contour_ids = inner + edge.gather(1, closest)
    ids = torch.cat([contour_ids, torch.arange(inner).expand(batch, -1)], 1)
    pick = ids[..., None]
    difference = px.gather(1, pick.expand(-1, -1, 2)) - target_px
    take = pick.expand(-1, -1, 3)
    return _Residuals(difference, in_camera.gather(1, take), ids)


def _jacobian(basis: _Basis, state: _State, at: _Residuals, camera: Camera) -> Tensor:
    """d(px) / d(omega, translation / depth, coefficients) at fixed correspondences [B, 68, 2, 6 + K].

    The rotation moves as exp(omega) R.
    """
    x, y, z = at.points_camera.unbind(-1)
    zero, scale = torch.zeros_like(x), camera.focal_px / -z
    rows_u = torch.stack([scale, zero, -scale * x / z], -1)
    rows_v = torch.stack([zero, -scale, scale * y / z], -1)
    px_by_camera = torch.stack([rows_u, rows_v], -2)  # [B, 68, 2, 3]
    turned = at.points_camera - state.translation_m[:, None]
    by_rotation = -px_by_camera @ skew_matrix(turned)
    by_translation = px_by_camera * -state.translation_m[:, None, None, 2:]
    px_by_head = px_by_camera @ state.rotation[:, None]
    contour, inner = px_by_head[:, : len(CONTOUR)], px_by_head[:, _INNER]
    by_contour = contour @ basis.modes[at.ids[:, : len(CONTOUR)]]
    by_inner = inner.permute(1, 0, 2, 3).flatten(1, 2) @ basis.modes[: 68 - len(CONTOUR)]
    by_inner = by_inner.unflatten(1, (-1, 2)).permute(1, 0, 2, 3)
    return torch.cat([by_rotation, by_translation, torch.cat([by_contour, by_inner], 1)], -1)


def _levenberg(
    basis: _Basis,
    state: _State,
    target_px: Tensor,
    camera: Camera,
    inverse_noise: Tensor,
    settings: FitSettings,
) -> _State:
    """Damped Gauss-Newton; each face accepts a step only where its cost falls."""
    damping = torch.full((len(target_px),), settings.damping, dtype=torch.float64)
    at = _residuals(basis, state, target_px, camera)
    cost = _cost(at, state, inverse_noise, settings.huber)
    for _ in range(settings.steps):
        step = _step(basis, state, at, camera, inverse_noise, damping, settings.huber)
        trial = _moved(state, step)
        trial_at = _residuals(basis, trial, target_px, camera)
        trial_cost = _cost(trial_at, trial, inverse_noise, settings.huber)
        accept = trial_cost < cost  # False for NaN
        state = trial.where(accept, state)
        at = _Residuals(
            *(
                torch.where(accept.reshape(-1, *[1] * (new.ndim - 1)), new, old)
                for new, old in ((getattr(trial_at, f.name), getattr(at, f.name)) for f in fields(at))
            )
        )
        cost = torch.where(accept, trial_cost, cost)
        damping = torch.where(accept, damping / 5, damping * 10).clamp(1e-9, 1e6)
    return state


def _cost(at: _Residuals, state: _State, inverse_noise: Tensor, huber: float) -> Tensor:
    """Huber's cost of the landmarks plus the Gaussian priors [B]."""
    distance = at.difference_px.norm(dim=-1) * inverse_noise
    robust = torch.where(distance <= huber, distance**2, huber * (2 * distance - huber))
    return robust.sum(1) + (state.coordinates**2).sum(1)


def _step(
    basis: _Basis,
    state: _State,
    at: _Residuals,
    camera: Camera,
    inverse_noise: Tensor,
    damping: Tensor,
    huber: float,
) -> Tensor:
    """The damped Gauss-Newton step [B, 6 + K] of the reweighted least squares."""
    distance = at.difference_px.norm(dim=-1) * inverse_noise
    weight = inverse_noise * (huber / distance.clamp(min=huber)).sqrt()  # [B, 68]
    jacobian = (_jacobian(basis, state, at, camera) * weight[..., None, None]).flatten(1, 2)
    residual = (at.difference_px * weight[..., None]).flatten(1, 2)
    prior = torch.ones(jacobian.shape[-1], dtype=torch.float64)
    prior[:6] = 0
    gradient = (residual[:, None] @ jacobian)[:, 0]
    gradient[:, 6:] += state.coordinates
    normal = jacobian.mT @ jacobian
    diagonal = normal.diagonal(dim1=1, dim2=2)
    diagonal += prior + damping[:, None] * (diagonal + prior)
    factor = torch.linalg.cholesky(normal)
    return -torch.cholesky_solve(gradient[..., None], factor)[..., 0]


def _moved(state: _State, step: Tensor) -> _State:
    omega, shift, change = step.split([3, 3, step.shape[1] - 6], dim=1)
    rotation = so3_exp(omega) @ state.rotation
    translation = state.translation_m - shift * state.translation_m[:, 2:]
    return _State(rotation, translation, state.coordinates + change)
