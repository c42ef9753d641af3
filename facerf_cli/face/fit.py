"""The pose of heads of known shape from their landmarks in a picture, without derivatives.

Where a fit starts: from the landmarks alone, or from a head that a Geometry Network saw.

That head is one of the built-in model. Any face model is seeded from it by least squares (DESIGN): its points
that the fit may use are laid on those of the head, by pose and shape together.

The face model fitted to 68 landmarks with strong statistical priors (paper, 'Landmark loss').

The camera is fixed; pose (rotation, translation), identity alpha and expression beta vary. Landmarks
alone say little about identity and nothing about most of the surface, so the priors are strong.
"""

import zipfile
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from functools import cache, lru_cache
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from torch import Tensor

from facerf_cli.errors import InputError
from facerf_cli.face.crop import Crop, check_landmarks
from facerf_cli.face.gauss_newton import (
    CONTOUR_RAYS,
    INNER_COUNT,
    POINTS_PER_RAY,
    FitBasis,
    FitState,
    Problem,
    fit_points,
    minimise,
    residuals,
    total_cost,
    weak_perspective,
)
from facerf_cli.face.morphable import MorphableModel, load_face_model
from facerf_cli.face.topology import CONTOUR, LANDMARKS_M, OUTER_EYE_CORNERS
from facerf_cli.raster.camera import Camera, pixel_rays, skew_matrix, so3_exp

_POSE_ROUNDS = 6


def pose_from_landmarks(
    points: Tensor, px: Tensor, camera: Camera, rotation: Tensor, translation_m: Tensor
) -> tuple[Tensor, Tensor]:
    """Rotations [B, 3, 3] and translations [B, 3] that lay points [B, N, 3] (head frame) on pixels [B, N, 2].

    One scaled orthographic fit at the depths of the pose that is given (DeMenthon and Davis, *Model-based
    object pose in 25 lines of code*, 1995), then a few rounds of orthogonal iteration (Lu, Hager and
    Mjolsness, *Fast and globally convergent pose estimation from video images*, 2000). float64.
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
    """Rotations [B, 3, 3] from points to others [B, N, 3], both about their middles (Kabsch, 1976)."""
    moment = (wanted - wanted.mean(1, keepdim=True)).mT @ (points - points.mean(1, keepdim=True))
    u, _, vh = torch.linalg.svd(moment)
    signs = torch.ones(len(points), 3, dtype=points.dtype)
    signs[:, 2] = torch.det(u @ vh).sign()
    return u @ (signs[..., None] * vh)


_START_ROUNDS = 2
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
    for _ in range(_START_ROUNDS):
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


Quality = Literal["good", "fair", "poor"]
GOOD_ERROR_IOD, FAIR_ERROR_IOD = 0.045, 0.08  # a mean landmark error up to this is a good, a fair fit
IOD_M = float(np.linalg.norm(np.subtract(*LANDMARKS_M[list(OUTER_EYE_CORNERS)])))
_INVISIBLE_M = 1e-4  # a direction of shape that moves no landmark further at one deviation is left out
_BORDER = 0.01  # of the crop's side: contour landmarks closer to the photo's border are guesses
_LARGEST_CROP_PX = 8192
_TENSORS = ("rotation", "translation_m", "alpha", "beta", "landmarks_px")


@dataclass(frozen=True)
class FitSettings:
    """One setting for all pictures: noise as a share of the inter-ocular distance, priors as deviations."""

    noise_inner: float = 0.03
    noise_contour: float = 0.08
    huber: float = 2.0  # landmarks further off than this many noise deviations count linearly
    identity_std: float = 0.3
    expression_std: float = 0.7
    steps: int = 20


@dataclass(frozen=True)
class FitBatch:
    """Fits of B faces, float64."""

    rotation: Tensor  # [B, 3, 3], head to camera
    translation_m: Tensor  # [B, 3]
    alpha: Tensor  # [B, Ki]
    beta: Tensor  # [B, Ke]
    error_iod: Tensor  # [B], mean distance of the trusted landmarks over that of the outer eye corners

    def vertices_camera(self, model: MorphableModel) -> Tensor:
        """The mesh in camera space [B, V, 3], float32."""
        vertices = model.vertices(self.alpha.float(), self.beta.float())
        return vertices @ self.rotation.float().mT + self.translation_m.float()[:, None]


@dataclass(frozen=True)
class FaceFit:
    """The fit of one photo's face; tensors float32."""

    model: str
    crop: Crop
    rotation: Tensor  # [3, 3], head to camera
    translation_m: Tensor  # [3]
    alpha: Tensor  # [Ki]
    beta: Tensor  # [Ke]
    landmarks_px: Tensor  # [68, 2], as given, in the crop's pixels
    error_iod: float  # mean distance of the trusted landmarks over that of the outer eye corners

    @property
    def camera(self) -> Camera:
        """The crop's fixed camera."""
        return self.crop.camera

    @property
    def quality(self) -> Quality:
        """'good' up to an error of `GOOD_ERROR_IOD`, 'fair' up to `FAIR_ERROR_IOD`, else 'poor'."""
        return quality_of(self.error_iod)

    def vertices_camera(self, model: MorphableModel) -> Tensor:
        """The mesh in camera space [V, 3]; `model` must be the one that was fitted."""
        if (model.name, len(model.identity), len(model.expression)) != (
            self.model,
            len(self.alpha),
            len(self.beta),
        ):
            raise ValueError(
                f"the fit is of the face model {self.model!r}, not of {model.name!r}; give its file"
            )
        vertices = model.vertices(self.alpha[None], self.beta[None])[0]
        return vertices @ self.rotation.mT + self.translation_m


def quality_of(error_iod: float) -> Quality:
    """What a mean landmark error says of a fit."""
    if error_iod <= GOOD_ERROR_IOD:
        return "good"
    return "fair" if error_iod <= FAIR_ERROR_IOD else "poor"


def fit_landmarks(
    model: MorphableModel,
    landmarks_px: np.ndarray,
    crop: Crop,
    settings: FitSettings = FitSettings(),
    trust: np.ndarray | None = None,
    start: FitStart | None = None,
) -> FaceFit:
    """Fit one face to landmarks [68, 2] in the crop's pixels; trust [68] in 0..1 weighs each landmark.

    `start` [1, ...] is where a Geometry Network sees the face in the crop, see `fit_batch`.
    """
    target_px = torch.from_numpy(check_landmarks(landmarks_px))
    weights = None if trust is None else torch.from_numpy(np.asarray(trust, np.float64))[None]
    fit = fit_batch(model, target_px[None], crop.camera, settings, weights, start)
    return FaceFit(
        model=model.name,
        crop=crop,
        rotation=fit.rotation[0].float(),
        translation_m=fit.translation_m[0].float(),
        alpha=fit.alpha[0].float(),
        beta=fit.beta[0].float(),
        landmarks_px=target_px.float(),
        error_iod=float(fit.error_iod[0]),
    )


def fit_batch(
    model: MorphableModel,
    landmarks_px: Tensor,
    camera: Camera,
    settings: FitSettings = FitSettings(),
    trust: Tensor | None = None,
    start: FitStart | None = None,
) -> FitBatch:
    """Fit B faces to landmarks [B, 68, 2] in the camera's pixels; trust [B, 68] in 0..1 weighs them.

    Each face starts from `start` or from its landmarks alone, whichever costs less.
    """
    target_px = torch.from_numpy(np.stack([check_landmarks(face.numpy()) for face in landmarks_px]))
    trust = torch.ones(target_px.shape[:2], dtype=torch.float64) if trust is None else trust.double()
    problem, begin = problem_of(model, target_px, camera, settings, trust)
    state = minimise(problem, begin if start is None else better_start(problem, begin, start), settings.steps)
    distance_px = residuals(problem, state).difference_px.norm(dim=-1)
    error_iod = (distance_px * trust).sum(1) / trust.sum(1) / _iod_px(target_px)
    coefficients = state.coordinates @ problem.basis.spread.mT
    alpha, beta = coefficients[:, : len(model.identity)], coefficients[:, len(model.identity) :]
    return FitBatch(state.rotation, state.translation_m, alpha, beta, error_iod)


def problem_of(
    model: MorphableModel, target_px: Tensor, camera: Camera, settings: FitSettings, trust: Tensor
) -> tuple[Problem, FitState]:
    """What is minimised for landmarks [B, 68, 2] of trust [B, 68], and the start that they alone give."""
    basis = fit_basis(model, settings)
    state, scale = weak_perspective(basis, target_px, camera)
    noise_px = landmark_noise(settings) * (IOD_M * scale)[:, None]  # [B, 68]
    return Problem(basis, target_px, camera, trust.sqrt() / noise_px, settings.huber), state


def better_start(problem: Problem, begin: FitState, start: FitStart) -> FitState:
    """Of each face the start that costs least: `begin`, the head closest to `start`, or it on the landmarks.

    The landmarks tell the pose better than a network does, and the network the shape.
    """
    for state in started(problem, start):
        cheaper = total_cost(problem, state) < total_cost(problem, begin)  # False for NaN
        begin = state.where(cheaper & (state.translation_m[:, 2] < 0), begin)
    return begin


def trust_inside(landmarks_px: np.ndarray, crop: Crop, height_px: int, width_px: int) -> np.ndarray:
    """Trust [68] that leaves out the contour landmarks (crop's pixels) at or beyond the photo's border.

    On tight crops the detector guesses the jaw there.
    """
    photo_px = crop.to_photo(landmarks_px)
    gap_px = np.minimum(photo_px, np.array([width_px, height_px]) - photo_px).min(-1)
    trust = np.ones(68)
    trust[list(CONTOUR)] = gap_px[list(CONTOUR)] > _BORDER * crop.side_px
    return trust


def fit_to_arrays(fit: FaceFit) -> dict[str, np.ndarray]:
    """A fit as plain arrays by name, for a file.

    In single precision: the last digits of a fit's doubles depend on where in memory they lay.
    """
    numbers = {"error_iod": np.float32(fit.error_iod)}
    tensors = {name: getattr(fit, name).numpy() for name in _TENSORS}
    crop = {name: np.array(value) for name, value in asdict(fit.crop).items()}
    return {"model": np.array(fit.model), **numbers, **crop, **tensors}


def fit_from_arrays(arrays: Mapping[str, np.ndarray]) -> FaceFit:
    """The fit of arrays by `fit_to_arrays`; ValueError, TypeError or KeyError where they are none."""
    tensors = {name: torch.from_numpy(arrays[name].astype(np.float32)) for name in _TENSORS}
    for name, shape in (("rotation", (3, 3)), ("translation_m", (3,)), ("landmarks_px", (68, 2))):
        if tensors[name].shape != shape:
            raise ValueError(f"{name} has the shape {tuple(tensors[name].shape)}, not {shape}")
    if tensors["alpha"].ndim != 1 or tensors["beta"].ndim != 1:
        raise ValueError("alpha and beta are no lists of coefficients")
    x0_px, y0_px, side_px, error_iod = (float(arrays[k]) for k in ("x0_px", "y0_px", "side_px", "error_iod"))
    crop = Crop(x0_px, y0_px, side_px, int(arrays["size_px"]))
    if not (0 < side_px < np.inf and 0 < crop.size_px <= _LARGEST_CROP_PX):
        raise ValueError(f"a crop of {side_px} pixels seen as {crop.size_px}")
    if not (
        all(tensor.isfinite().all() for tensor in tensors.values()) and np.isfinite([x0_px, y0_px]).all()
    ):
        raise ValueError("it holds values that are not finite")
    return FaceFit(str(arrays["model"]), crop, error_iod=error_iod, **tensors)


def save_fit(path: Path, fit: FaceFit, metadata: Mapping[str, str | int] | None = None) -> None:
    """Write a fit as .npz without pickles; `metadata` beside it, such as where it comes from."""
    with path.open("wb") as file:
        np.savez(file, **{**(metadata or {}), **fit_to_arrays(fit)})  # type: ignore[arg-type]


def load_fit(path: Path) -> FaceFit:
    """Read a fit that `save_fit` wrote."""
    try:
        with np.load(path, allow_pickle=False) as file:
            return fit_from_arrays({key: file[key] for key in file.files})
    except (ValueError, TypeError, OSError, EOFError, KeyError, zipfile.BadZipFile) as error:
        raise InputError(f"{path}: not a fit that facerf wrote ({error}); fit the photo again") from None


def landmark_noise(settings: FitSettings) -> Tensor:
    """Deviation of each landmark [68], a share of the inter-ocular distance."""
    noise = torch.full((68,), settings.noise_inner, dtype=torch.float64)
    noise[list(CONTOUR)] = settings.noise_contour
    return noise


def _iod_px(landmarks_px: Tensor) -> Tensor:
    left, right = OUTER_EYE_CORNERS
    return (landmarks_px[:, left] - landmarks_px[:, right]).norm(dim=-1)


@lru_cache(maxsize=4)
def fit_basis(model: MorphableModel, settings: FitSettings) -> FitBasis:
    """The model at the points that a fit may use, with the settings' priors; once for each pair."""
    corners, weights = fit_points()
    modes, spread = _turned(model, settings, corners, weights.double())
    mean = (model.mean[corners].double() * weights[..., None].double()).sum(1)
    ends_m = mean[INNER_COUNT:].reshape(CONTOUR_RAYS, POINTS_PER_RAY, 3)[:, -1]
    nose_m = mean[[28 - len(CONTOUR), 33 - len(CONTOUR)]].mean(0)
    outward = (ends_m - nose_m) * torch.tensor([1.0, 1.0, 0.0])
    return FitBasis(mean, modes, spread, outward / outward.norm(dim=-1, keepdim=True))


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
