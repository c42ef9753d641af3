"""The face model fitted to 68 landmarks with strong statistical priors (paper, 'Landmark loss').

The camera is fixed; pose (rotation, translation), identity alpha and expression beta vary. Landmarks
alone constrain identity little and most of the surface not at all, so the priors are strong.
"""

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from torch import Tensor

from facerf_cli.errors import InputError
from facerf_cli.face.crop import Crop, check_landmarks
from facerf_cli.face.gauss_newton import (
    INNER_COUNT,
    FitBasis,
    FitState,
    Problem,
    fit_points,
    minimise,
    pose_from_landmarks,
    residuals,
    total_cost,
    weak_perspective,
)
from facerf_cli.face.morphable import MorphableModel, load_face_model, read_npz
from facerf_cli.face.topology import (
    CONTOUR,
    CONTOUR_RAYS,
    LANDMARKS_M,
    NOSE,
    OUTER_EYE_CORNERS,
    POINTS_PER_RAY,
)
from facerf_cli.files.texts import require_regular
from facerf_cli.raster.camera import Camera, project, skew_matrix, so3_exp

GOOD_ERROR_IOD, FAIR_ERROR_IOD = 0.045, 0.08  # the largest mean landmark errors of a good and of a fair fit
IOD_M = float(np.linalg.norm(np.subtract(*LANDMARKS_M[list(OUTER_EYE_CORNERS)])))
_INVISIBLE_M = 1e-4  # a shape direction that moves every landmark by less at one deviation is left out
_SEED_ROUNDS = 2
_NOISE_M = 0.0003  # this distance of a seed's point costs as much as one standard deviation of a coordinate
_BORDER = 0.01  # share of the crop's side: contour landmarks closer to the photo's border are guesses
_LARGEST_CROP_PX = 8192
_MOST_ARRAY_BYTES = 1 << 16  # of a fit in a file
_TENSORS = ("rotation", "translation_m", "alpha", "beta", "landmarks_px")  # of a FaceFit, in its file

Quality = Literal["good", "fair", "poor", "unknown"]
Geometry = Literal["landmarks", "network"]  # fitted to landmarks, or regressed by the Geometry Network


@dataclass(frozen=True)
class FitSettings:
    """Settings for all images: noise as a share of the inter-ocular distance, priors as deviations."""

    noise_inner: float = 0.03
    noise_contour: float = 0.08
    huber: float = 2.0  # errors above this many noise deviations count linearly
    identity_std: float = 0.3
    expression_std: float = 0.7
    steps: int = 20


@dataclass(frozen=True)
class FaceFit:
    """The head of one photo's face, fitted to landmarks or regressed from the crop; tensors float32."""

    model: str
    crop: Crop
    rotation: Tensor  # [3, 3], head to camera
    translation_m: Tensor  # [3]
    alpha: Tensor  # [Ki]
    beta: Tensor  # [Ke]
    landmarks_px: Tensor  # [68, 2] in the crop's pixels: the targets of the fit, or the regressed head's own
    # mean error of the trusted landmarks over the distance of the outer eye corners; NaN without landmarks
    error_iod: float

    @property
    def camera(self) -> Camera:
        """The crop's fixed camera."""
        return self.crop.camera

    @property
    def head_to_camera(self) -> np.ndarray:
        """The pose [4, 4], m."""
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = self.rotation.numpy(), self.translation_m.numpy()
        return pose

    @property
    def quality(self) -> Quality:
        """'good' up to an error of `GOOD_ERROR_IOD`, 'fair' up to `FAIR_ERROR_IOD`, else 'poor'.

        'unknown' if the head was regressed, without landmarks to compare it with.
        """
        return quality_of(self.error_iod)

    def turn_to(self, rotation: Tensor) -> Tensor:
        """The rotation [3, 3] of camera-space vectors from this pose to another, head_to_camera [3, 3]."""
        return rotation @ self.rotation.T

    def vertices_camera(self, model: MorphableModel) -> Tensor:
        """The mesh in camera space [V, 3]; raises ValueError unless `model` is the fitted model."""
        if (model.name, len(model.identity), len(model.expression)) != (
            self.model,
            len(self.alpha),
            len(self.beta),
        ):
            raise ValueError(
                f"face model {model.name!r}: the fit was made with {self.model!r}; give that model's file"
            )
        vertices = model.vertices(self.alpha[None], self.beta[None])[0]
        return vertices @ self.rotation.mT + self.translation_m


@dataclass(frozen=True)
class FitStart:
    """Heads of B faces to start from, in the space of the fit's camera.

    alpha and beta may have fewer coefficients than their model; the missing ones are zero.
    """

    rotation: Tensor  # [B, 3, 3] head_to_camera
    translation_m: Tensor  # [B, 3]
    alpha: Tensor  # [B, Ki]
    beta: Tensor  # [B, Ke]
    model: MorphableModel | None = field(default=None, kw_only=True)  # theirs; None: the built-in


@dataclass(frozen=True)
class FitBatch(FitStart):
    """Fits of B faces, float64."""

    error_iod: Tensor  # [B], see FaceFit

    def vertices_camera(self, model: MorphableModel) -> Tensor:
        """The mesh in camera space [B, V, 3], float32."""
        vertices = model.vertices(self.alpha.float(), self.beta.float())
        return vertices @ self.rotation.float().mT + self.translation_m.float()[:, None]


def quality_of(error_iod: float) -> Quality:
    """The quality of a fit with this mean landmark error; see `FaceFit.quality`."""
    if math.isnan(error_iod):
        return "unknown"
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
    """Fit one face to landmarks.

    Args:
        model: The face model.
        landmarks_px: [68, 2] in the crop's pixels.
        crop: The crop, whose camera is fixed.
        settings: Weights and steps.
        trust: Weight [68] in 0..1 of each landmark.
        start: A Geometry Network's prediction [1, ...] for the crop, see `fit_batch`.
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


def regressed_fit(
    model: MorphableModel, regressed: tuple[Tensor, Tensor, Tensor, Tensor], crop: Crop
) -> FaceFit:
    """The head that a Geometry Network regressed from a crop (paper, 'Network Architecture').

    `regressed` are rotation [1, 3, 3], translation [1, 3] in metres, and the model's first alpha [1, Ki] and
    beta [1, Ke].
    """
    rotation, translation_m, *found = (tensor[0].float() for tensor in regressed)
    alpha, beta = (
        torch.nn.functional.pad(some, (0, len(basis) - len(some)))
        for some, basis in zip(found, (model.identity, model.expression), strict=True)
    )
    vertices = model.vertices(alpha[None], beta[None])[0] @ rotation.mT + translation_m
    landmarks_px = project(model.landmarks(vertices[None])[0], crop.camera)
    return FaceFit(model.name, crop, rotation, translation_m, alpha, beta, landmarks_px, math.nan)


def fit_batch(
    model: MorphableModel,
    landmarks_px: Tensor,
    camera: Camera,
    settings: FitSettings = FitSettings(),
    trust: Tensor | None = None,
    start: FitStart | None = None,
) -> FitBatch:
    """Fit B faces, each from `start` or from its landmarks alone, whichever costs less.

    Args:
        model: The face model.
        landmarks_px: [B, 68, 2] in the camera's pixels.
        camera: The crops' camera.
        settings: Weights and steps.
        trust: Weight [B, 68] in 0..1 of each landmark.
        start: A Geometry Network's predictions [B, ...].
    """
    target_px = torch.from_numpy(np.stack([check_landmarks(face.numpy()) for face in landmarks_px]))
    trust = torch.ones(target_px.shape[:2], dtype=torch.float64) if trust is None else trust.double()
    problem, begin = fit_problem(model, target_px, camera, settings, trust)
    state = minimise(problem, begin if start is None else better_start(problem, begin, start), settings.steps)
    distance_px = residuals(problem, state).difference_px.norm(dim=-1)
    left, right = OUTER_EYE_CORNERS
    iod_px = (target_px[:, left] - target_px[:, right]).norm(dim=-1)
    error_iod = (distance_px * trust).sum(1) / trust.sum(1) / iod_px
    coefficients = state.coordinates @ problem.basis.spread.mT
    alpha, beta = coefficients[:, : len(model.identity)], coefficients[:, len(model.identity) :]
    return FitBatch(state.rotation, state.translation_m, alpha, beta, error_iod)


def fit_problem(
    model: MorphableModel, target_px: Tensor, camera: Camera, settings: FitSettings, trust: Tensor
) -> tuple[Problem, FitState]:
    """Pose the problem of landmarks, and the start that they alone give.

    Args:
        model: The face model.
        target_px: Landmarks [B, 68, 2] in the camera's pixels.
        camera: The crops' camera.
        settings: Weights and steps.
        trust: Weight [B, 68] in 0..1 of each landmark.
    """
    basis = fit_basis(model, settings)
    state, scale = weak_perspective(basis, target_px, camera)
    noise_px = landmark_noise(settings) * (IOD_M * scale)[:, None]  # [B, 68]
    return Problem(basis, target_px, camera, trust.sqrt() / noise_px, settings.huber), state


def landmark_noise(settings: FitSettings) -> Tensor:
    """The standard deviation of each landmark [68] as a share of the inter-ocular distance."""
    noise = torch.full((68,), settings.noise_inner, dtype=torch.float64)
    noise[list(CONTOUR)] = settings.noise_contour
    return noise


@lru_cache(maxsize=4)
def fit_basis(model: MorphableModel, settings: FitSettings) -> FitBasis:
    """The model at the points of a fit, with the settings' priors; cached by model and settings."""
    corners, weights = fit_points()
    modes, spread = _principal_modes(model, settings, corners, weights.double())
    mean = (model.mean[corners].double() * weights[..., None].double()).sum(1)
    ends_m = mean[INNER_COUNT:].reshape(CONTOUR_RAYS, POINTS_PER_RAY, 3)[:, -1]
    nose_m = mean[[landmark - len(CONTOUR) for landmark in NOSE]].mean(0)
    outward = (ends_m - nose_m) * torch.tensor([1.0, 1.0, 0.0])
    return FitBasis(mean, modes, spread, outward / outward.norm(dim=-1, keepdim=True))


def _principal_modes(
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
    weights = _weights(len(basis.mean))[:, None]
    flat = (by_parameters * weights[..., None]).flatten(0, 1)
    prior = torch.ones(flat.shape[1], dtype=flat.dtype)
    prior[:6] = 0
    factor = torch.linalg.cholesky(flat.mT @ flat + prior.diag())
    coordinates = torch.zeros(len(wanted), flat.shape[1] - 6, dtype=flat.dtype)
    for _ in range(_SEED_ROUNDS):
        points = basis.mean + (coordinates @ basis.modes.flatten(0, 1).mT).reshape(len(wanted), -1, 3)
        off = (wanted - translation[:, None]) @ rotation - points  # head frame
        right = (off * weights).flatten(1) @ flat
        right[:, 6:] -= coordinates
        step = torch.cholesky_solve(right.mT, factor).mT
        translation = translation + (rotation @ step[:, 3:6, None])[..., 0]
        rotation = rotation @ so3_exp(step[:, :3])
        coordinates = coordinates + step[:, 6:]
    return FitState(rotation, translation, coordinates)


def _weights(count: int) -> Tensor:
    """Weights [N] of `count` points in 1 / m; all contour points together count as the inner ones do."""
    weights = torch.full((count,), (INNER_COUNT / (count - INNER_COUNT)) ** 0.5, dtype=torch.float64)
    weights[:INNER_COUNT] = 1
    return weights / _NOISE_M


def _points_camera(start: FitStart) -> Tensor:
    """The points of `fit_points` [B, N, 3] on the start's heads, camera space, float64."""
    model, (corners, weights) = start.model or load_face_model(), fit_points()
    mean, identity, expression = (
        (basis[..., corners, :].double() * weights[..., None].double()).sum(-2)
        for basis in (model.mean, model.identity, model.expression)
    )
    alpha, beta = start.alpha.double(), start.beta.double()
    offset = torch.einsum("bk,knc->bnc", alpha, identity[: alpha.shape[1]])
    offset = offset + torch.einsum("bk,knc->bnc", beta, expression[: beta.shape[1]])
    return (mean + offset) @ start.rotation.double().mT + start.translation_m.double()[:, None]


def trust_inside(landmarks_px: np.ndarray, crop: Crop, height_px: int, width_px: int) -> np.ndarray:
    """Trust [68] that leaves out the contour landmarks (crop's pixels) at or beyond the photo's border.

    On tight crops the detector guesses the jaw there.
    """
    photo_px = crop.to_photo(landmarks_px)
    gap_px = np.minimum(photo_px, np.array([width_px, height_px]) - photo_px).min(-1)
    trust = np.ones(68)
    trust[list(CONTOUR)] = gap_px[list(CONTOUR)] > _BORDER * crop.side_px
    return trust


def save_fit(path: Path, fit: FaceFit, metadata: Mapping[str, str | int] | None = None) -> None:
    """Write a fit and its `metadata` (such as its source) as .npz without pickles."""
    with path.open("wb") as file:
        np.savez(file, **{**(metadata or {}), **fit_to_arrays(fit)})  # type: ignore[arg-type]


def load_fit(path: Path) -> FaceFit:
    """Read a fit that `save_fit` wrote; raises InputError for any other file."""
    require_regular(path, "fit the photo again")
    try:
        return fit_from_arrays(read_npz(path, _MOST_ARRAY_BYTES))
    except (ValueError, TypeError, KeyError, OverflowError) as error:
        raise InputError(f"{path}: not a fit that facerf wrote ({error}); fit the photo again") from None


def fit_to_arrays(fit: FaceFit) -> dict[str, np.ndarray]:
    """Convert a fit to named arrays for a file.

    Numbers are in single precision: the last digits of a fit's doubles depend on memory alignment.
    """
    crop = {name: np.array(value) for name, value in asdict(fit.crop).items()}
    tensors = {name: getattr(fit, name).numpy() for name in _TENSORS}
    return {"model": np.array(fit.model), "error_iod": np.float32(fit.error_iod), **crop, **tensors}


def fit_from_arrays(arrays: Mapping[str, np.ndarray]) -> FaceFit:
    """The fit of `fit_to_arrays`; raises ValueError, TypeError or KeyError for other arrays."""
    tensors = {name: torch.from_numpy(arrays[name].astype(np.float32)) for name in _TENSORS}
    for name, shape in (("rotation", (3, 3)), ("translation_m", (3,)), ("landmarks_px", (68, 2))):
        if tensors[name].shape != shape:
            raise ValueError(f"{name} has the shape {tuple(tensors[name].shape)}, not {shape}")
    if tensors["alpha"].ndim != 1 or tensors["beta"].ndim != 1:
        raise ValueError("alpha and beta are not lists of coefficients")
    x0_px, y0_px, side_px, error_iod = (float(arrays[k]) for k in ("x0_px", "y0_px", "side_px", "error_iod"))
    crop = Crop(x0_px, y0_px, side_px, int(arrays["size_px"]))
    if not (0 < side_px < np.inf and 0 < crop.size_px <= _LARGEST_CROP_PX):
        raise ValueError(f"the crop's side is {side_px} photo pixels and {crop.size_px} crop pixels")
    if not (
        all(tensor.isfinite().all() for tensor in tensors.values()) and np.isfinite([x0_px, y0_px]).all()
    ):
        raise ValueError("it holds values that are not finite")
    return FaceFit(str(arrays["model"]), crop, error_iod=error_iod, **tensors)
