"""Fit of the face model to 68 landmarks with strong statistical priors (paper, 'Landmark loss').

The camera is fixed; pose (rotation, translation), identity alpha and expression beta vary. The priors are
strong because landmarks constrain identity weakly and most of the surface not at all.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from torch import Tensor

from facerf_cli.errors import InputError
from facerf_cli.face.crop import Crop, check_landmarks, from_landmarks
from facerf_cli.face.gauss_newton import (
    FitBasis,
    FitState,
    Problem,
    Views,
    least_from_pitches,
    residuals,
    weak_perspective,
)
from facerf_cli.face.morphable import MorphableModel, read_npz
from facerf_cli.face.topology import (
    CONTOUR,
    CONTOUR_RAYS,
    LANDMARK_UV,
    LANDMARKS_M,
    NOSE,
    OUTER_EYE_CORNERS,
    POINTS_PER_RAY,
    band_uv,
    grid_triangles,
    locate,
)
from facerf_cli.files.texts import require_regular
from facerf_cli.raster.camera import Camera, PosedCamera, project
from facerf_cli.raster.rasterize import front_facing

GOOD_ERROR_IOD, FAIR_ERROR_IOD = 0.045, 0.08  # largest mean landmark errors of a good and of a fair fit
IOD_M = float(np.linalg.norm(np.subtract(*LANDMARKS_M[list(OUTER_EYE_CORNERS)])))
_INVISIBLE_M = 1e-4  # shape directions that move every landmark by less at one deviation are dropped
LOST_IOD = 0.15  # landmarks with a larger mean error belong to another face or to none
# The last bits of linear algebra depend on memory alignment. Rounding far above those bits, and far below any
# measurable difference, makes equal inputs give equal bytes.
DECIMALS = 6
CROP_PX, CROP_STEP_PX = 256, 8  # largest default side of a prepared crop, and a divisor of its side
_CROP_STRIDE = 5  # the pose in a crop is fitted to every fifth vertex
_LEAST_FACING = 0.1  # fraction of the vertices that must face the camera
_NO_OUTLIER = 1e9  # Huber threshold in deviations; makes all errors quadratic
_BORDER = 0.01  # fraction of the crop's side; contour landmarks closer to the photo's border are guesses
_LARGEST_CROP_PX = 8192
_MOST_ARRAY_BYTES = 1 << 16  # of a fit's file
_TENSORS = ("rotation", "translation_m", "alpha", "beta", "landmarks_px")  # of a FaceFit, in its file

Quality = Literal["good", "fair", "poor", "unknown"]
Geometry = Literal["landmarks", "network"]  # fitted to landmarks, or regressed by the Geometry Network


@dataclass(frozen=True)
class FitSettings:
    """Noise deviations, in inter-ocular distances, and prior deviations of the coefficients."""

    noise_inner: float = 0.03
    noise_contour: float = 0.08
    huber: float = 2.0  # errors above this many noise deviations count linearly
    identity_std: float = 0.3
    expression_std: float = 0.7
    steps: int = 20


@dataclass(frozen=True)
class FaceFit:
    """Head of a photo's face, fitted to landmarks or regressed from the crop; tensors are float32."""

    model: str
    crop: Crop
    rotation: Tensor  # [3, 3], head to camera
    translation_m: Tensor  # [3]
    alpha: Tensor  # [Ki]
    beta: Tensor  # [Ke]
    landmarks_px: Tensor  # [68, 2] in the crop's pixels: the targets of the fit, or the regressed landmarks
    # mean error of the trusted landmarks over the distance of the outer eye corners; NaN without landmarks
    error_iod: float

    @property
    def camera(self) -> Camera:
        """The crop's fixed camera."""
        return self.crop.camera

    @property
    def head_to_camera(self) -> np.ndarray:
        """Pose [4, 4] in metres."""
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = self.rotation.numpy(), self.translation_m.numpy()
        return pose

    @property
    def quality(self) -> Quality:
        """Rating of the landmark error; 'unknown' if the head was regressed without landmarks."""
        return quality_of(self.error_iod)

    def turn_to(self, rotation: Tensor) -> Tensor:
        """Return the rotation [3, 3] of camera-space vectors from this pose to `rotation`, head to camera."""
        return rotation @ self.rotation.T

    def vertices_camera(self, model: MorphableModel) -> Tensor:
        """Compute the mesh [V, 3] in camera space; raises ValueError unless `model` is the fitted model."""
        sizes = len(model.identity), len(model.expression)
        if (model.name, *sizes) != (self.model, len(self.alpha), len(self.beta)):
            raise ValueError(
                f"face model {model.name!r}: the fit uses {self.model!r}; pass that model's file"
            )
        vertices = model.vertices(self.alpha[None], self.beta[None])[0]
        return vertices @ self.rotation.mT + self.translation_m


@dataclass(frozen=True)
class Heads:
    """Fitted heads of B faces in the common space of their views, float64."""

    rotation: Tensor  # [B, 3, 3], from the head frame
    translation_m: Tensor  # [B, 3]
    alpha: Tensor  # [B, Ki]
    beta: Tensor  # [B, Ke]
    off: Tensor  # [N], mean landmark distance of each view, weighted by trust, over the focal length

    def vertices(self, model: MorphableModel) -> Tensor:
        """Compute the meshes [B, V, 3] in the common space, float64."""
        vertices = model.vertices(self.alpha.float(), self.beta.float()).double()
        return vertices @ self.rotation.mT + self.translation_m[:, None]


def quality_of(error_iod: float) -> Quality:
    """Rate a mean landmark error, relative to the inter-ocular distance; NaN is 'unknown'."""
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
) -> FaceFit:
    """Fit one face to landmarks [68, 2] in the crop's pixels; `trust` [68] in 0..1 weights the landmarks."""
    target_px = torch.from_numpy(check_landmarks(landmarks_px))
    weights = None if trust is None else torch.from_numpy(np.asarray(trust, np.float64))[None]
    fit = fit_batch(model, target_px[None], crop.camera, settings, weights)
    left, right = OUTER_EYE_CORNERS
    iod_px = (target_px[left] - target_px[right]).norm()
    return FaceFit(
        model=model.name,
        crop=crop,
        rotation=fit.rotation[0].float(),
        translation_m=fit.translation_m[0].float(),
        alpha=fit.alpha[0].float(),
        beta=fit.beta[0].float(),
        landmarks_px=target_px.float(),
        error_iod=float(fit.off[0] * crop.camera.focal_px / iod_px),
    )


def regressed_fit(
    model: MorphableModel, regressed: tuple[Tensor, Tensor, Tensor, Tensor], crop: Crop
) -> FaceFit:
    """Build the head that a Geometry Network regressed from a crop (paper, 'Network Architecture').

    `regressed` contains rotation [1, 3, 3], translation [1, 3] in metres, and the model's first alpha [1, Ki]
    and beta [1, Ke].
    """
    rotation, translation_m, *first = (tensor[0].float() for tensor in regressed)
    alpha, beta = (
        torch.nn.functional.pad(coefficients, (0, len(basis) - len(coefficients)))
        for coefficients, basis in zip(first, (model.identity, model.expression), strict=True)
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
) -> Heads:
    """Fit B faces of different photos in the space of their crops' camera.

    `landmarks_px` [B, 68, 2] are in the camera's pixels; `trust` [B, 68] in 0..1 weights the landmarks.
    """
    target_px = torch.from_numpy(np.stack([check_landmarks(face.numpy()) for face in landmarks_px]))
    trust = torch.ones(target_px.shape[:2], dtype=torch.float64) if trust is None else trust.double()
    return fit_heads(model, views_of_photos(target_px, camera, trust), settings)


def views_of_photos(target_px: Tensor, camera: Camera, trust: Tensor) -> Views:
    """Build one view of each of B heads, whose common space is the camera's."""
    plane = (target_px - torch.tensor([camera.cx_px, camera.cy_px], dtype=torch.float64)) / camera.focal_px
    count, identity = len(plane), torch.eye(3, dtype=torch.float64)
    rotation = identity.expand(count, -1, -1)
    return Views(plane, trust, torch.arange(count), rotation, identity.new_zeros(count, 3))


def fit_heads(model: MorphableModel, views: Views, settings: FitSettings) -> Heads:
    """Fit B heads to the landmarks of N views, from three pitches; keep the least cost of each head."""
    problem, by_view = fit_problem(model, views, settings)
    state = least_from_pitches(problem, by_view, settings.steps)
    off = (residuals(problem, state).difference.norm(dim=-1) * views.trust).sum(1) / views.trust.sum(1)
    coefficients = state.coordinates @ problem.basis.spread.mT
    alpha, beta = coefficients[:, : len(model.identity)], coefficients[:, len(model.identity) :]
    return Heads(state.rotation, state.translation_m, alpha, beta, off)


def fit_problem(model: MorphableModel, views: Views, settings: FitSettings) -> tuple[Problem, FitState]:
    """Set up the problem of N views, with an estimate of the head [N] from each view."""
    basis = fit_basis(model, settings)
    by_view, scale = weak_perspective(basis, views)
    noise = torch.full((68,), settings.noise_inner, dtype=torch.float64)
    noise[list(CONTOUR)] = settings.noise_contour
    inverse_noise = views.trust.sqrt() / (noise * (IOD_M * scale)[:, None])
    return Problem(basis, views, inverse_noise, settings.huber), by_view


def fit_views(
    model: MorphableModel, cameras: Sequence[PosedCamera], landmarks_px: Sequence[np.ndarray | None]
) -> tuple[Heads, np.ndarray]:
    """Fit one head in world space to landmarks [68, 2] in the pixels of W calibrated cameras.

    The landmarks of a camera without a face are None. Landmarks that contradict the other cameras
    (`LOST_IOD`) are excluded. Returns the head, and for each camera the mean distance [W] of its trusted
    landmarks over the inter-ocular distance of a frontal face, NaN without landmarks. Raises InputError if no
    camera has landmarks.
    """
    views = [(index, cameras[index], px) for index, px in enumerate(landmarks_px) if px is not None]
    if not views:
        raise InputError("no camera shows a face; use frames from the front of the subject")
    while True:
        head = _head_in_world(model, [(camera, px) for _, camera, px in views])
        rotation = torch.stack([camera.rotation for _, camera, _ in views])
        shift_m = torch.stack([camera.translation_m for _, camera, _ in views])
        depth_m = eyes_depth_m(rotation @ head.rotation, rotation @ head.translation_m[0] + shift_m)
        off_iod = (head.off * depth_m / IOD_M).round(decimals=DECIMALS).tolist()
        limit = max(LOST_IOD, min(off_iod))
        kept = [view for view, off in zip(views, off_iod, strict=True) if off <= limit]
        if len(kept) == len(views):
            errors_iod = np.full(len(cameras), np.nan)
            errors_iod[[index for index, *_ in views]] = off_iod
            return head, errors_iod
        views = kept


def _head_in_world(model: MorphableModel, images: Sequence[tuple[PosedCamera, np.ndarray]]) -> Heads:
    """Fit one head in the first camera's space, so that the fit does not depend on the world's axes."""
    plane = torch.stack([camera.to_plane(torch.from_numpy(check_landmarks(px))) for camera, px in images])
    crops = [from_landmarks(px, CROP_PX) for _, px in images]
    trust = [
        trust_inside(crop.to_crop(px), crop, camera.height_px, camera.width_px)
        for crop, (camera, px) in zip(crops, images, strict=True)
    ]
    first = images[0][0]
    to_camera = torch.stack([camera.rotation for camera, _ in images]) @ first.rotation.mT
    shift_m = torch.stack([camera.translation_m for camera, _ in images]) - to_camera @ first.translation_m
    same_head = torch.zeros(len(images), dtype=torch.int64)
    views = Views(plane, torch.from_numpy(np.stack(trust)), same_head, to_camera, shift_m)
    head = fit_heads(model, views, FitSettings())
    rotation = first.rotation.mT @ head.rotation
    translation_m = (head.translation_m - first.translation_m) @ first.rotation
    return Heads(
        rotation.round(decimals=DECIMALS + 1),
        translation_m.round(decimals=DECIMALS),
        head.alpha.round(decimals=DECIMALS),
        head.beta.round(decimals=DECIMALS),
        head.off,
    )


def eyes_depth_m(rotation: Tensor, translation_m: Tensor) -> Tensor:
    """Return the depth of the eyes along the camera's axis [...] for poses [..., 3, 3] and [..., 3]."""
    eyes = torch.from_numpy(LANDMARKS_M[list(OUTER_EYE_CORNERS)].mean(0))
    return -(rotation @ eyes + translation_m)[..., 2]


def fit_in_crop(
    model: MorphableModel,
    head: Heads,
    camera: PosedCamera,
    landmarks_px: np.ndarray | None,
    error_iod: float,
    crop_px: int | None,
) -> tuple[FaceFit, float]:
    """Pose the head of `fit_views` in the fixed camera of its crop of a camera's image.

    The crop follows the fitted landmarks. Identity and expression stay; the pose brings the vertices that
    face the camera as close as possible to their pixels in the true camera. Returns the fit, and the mean
    remaining distance over the inter-ocular distance.

    Args:
        model: The face model.
        head: The head in world space.
        camera: The true camera.
        landmarks_px: [68, 2] in its image; without them, the fit stores the fitted landmarks.
        error_iod: Error of the joint fit in this camera, over the inter-ocular distance.
        crop_px: Side of the crop; None: at most `CROP_PX`, without enlarging the camera's image.

    Raises:
        InputError: The camera is behind the head.
    """
    vertices_world = head.vertices(model)[0]
    fitted_px = camera.project(model.landmarks(vertices_world[None])[0]).numpy()
    crop = from_landmarks(fitted_px, crop_px or CROP_PX)
    rounded = {key: round(getattr(crop, key), DECIMALS) for key in ("x0_px", "y0_px", "side_px")}
    crop = replace(crop, **rounded)
    if crop_px is None:
        image_px = int(crop.side_px) // CROP_STEP_PX * CROP_STEP_PX
        crop = replace(crop, size_px=min(crop.size_px, max(image_px, CROP_STEP_PX)))
    in_camera = vertices_world @ camera.rotation.mT + camera.translation_m
    triangles = grid_triangles()
    facing = torch.unique(triangles[front_facing(in_camera, triangles)])
    if len(facing) < _LEAST_FACING * len(in_camera):
        raise InputError("a camera is behind the head")
    ids = facing[::_CROP_STRIDE]
    target_px = torch.from_numpy(crop.to_crop(camera.project(vertices_world[ids]).numpy()))
    points = (vertices_world[ids] - head.translation_m) @ head.rotation[0]
    rigid = FitBasis(points, points.new_zeros(*points.shape, 0), points.new_zeros(0, 0), points[:0])
    equal = torch.ones_like(target_px[None, :, 0])
    views = views_of_photos(target_px[None], crop.camera, equal)
    problem = Problem(rigid, views, equal, _NO_OUTLIER)
    pose = least_from_pitches(problem, weak_perspective(rigid, views)[0], FitSettings().steps)
    off = residuals(problem, pose).difference.norm(dim=-1).mean()
    stored_px = np.round(fitted_px, DECIMALS) if landmarks_px is None else landmarks_px
    fit = FaceFit(
        model=model.name,
        crop=crop,
        rotation=pose.rotation[0].round(decimals=DECIMALS + 1).float(),
        translation_m=pose.translation_m[0].round(decimals=DECIMALS).float(),
        alpha=head.alpha[0].float(),
        beta=head.beta[0].float(),
        landmarks_px=torch.from_numpy(crop.to_crop(stored_px)).float(),
        error_iod=error_iod,
    )
    return fit, float(off * eyes_depth_m(pose.rotation[0], pose.translation_m[0]) / IOD_M)


@lru_cache(maxsize=4)
def fit_basis(model: MorphableModel, settings: FitSettings) -> FitBasis:
    """Evaluate the model at the points of a fit, with the settings' priors."""
    corners, weights = locate(np.concatenate([LANDMARK_UV[len(CONTOUR) :], band_uv().reshape(-1, 2)]))
    modes, spread = _principal_modes(model, settings, corners, weights.double())
    mean = (model.mean[corners].double() * weights[..., None].double()).sum(1)
    ends_m = mean[68 - len(CONTOUR) :].reshape(CONTOUR_RAYS, POINTS_PER_RAY, 3)[:, -1]
    nose_m = mean[[landmark - len(CONTOUR) for landmark in NOSE]].mean(0)
    outward = (ends_m - nose_m) * torch.tensor([1.0, 1.0, 0.0])
    return FitBasis(mean, modes, spread, outward / outward.norm(dim=-1, keepdim=True))


def _principal_modes(
    model: MorphableModel, settings: FitSettings, corners: Tensor, weights: Tensor
) -> tuple[Tensor, Tensor]:
    """Compute the modes [N, 3, Q] at N points of the mesh, and the spread [K, Q] of their coordinates."""
    modes = torch.cat([model.identity[:, corners], model.expression[:, corners]]).double()  # [K, N, 3, 3]
    stds = torch.full((len(modes),), settings.expression_std, dtype=torch.float64)
    stds[: len(model.identity)] = settings.identity_std
    whitened = torch.einsum("k,nc,kncx->nxk", stds, weights, modes)
    principal = torch.linalg.svd(whitened.flatten(0, 1), full_matrices=False).Vh.mT
    modes = whitened @ principal
    visible = modes.norm(dim=1).amax(0) > _INVISIBLE_M
    return modes[..., visible], stds[:, None] * principal[:, visible]


def trust_inside(landmarks_px: np.ndarray, crop: Crop, height_px: int, width_px: int) -> np.ndarray:
    """Return weights [68] of landmarks in crop pixels that exclude the contour near the photo's border.

    The detector guesses the jaw there.
    """
    photo_px = crop.to_photo(landmarks_px)
    gap_px = np.minimum(photo_px, np.array([width_px, height_px]) - photo_px).min(-1)
    trust = np.ones(68)
    trust[list(CONTOUR)] = gap_px[list(CONTOUR)] > _BORDER * crop.side_px
    return trust


def save_fit(path: Path, fit: FaceFit, metadata: Mapping[str, str | int] | None = None) -> None:
    """Write a fit and its `metadata`, such as its source, to an .npz without pickles."""
    with path.open("wb") as file:
        np.savez(file, **{**(metadata or {}), **fit_to_arrays(fit)})  # type: ignore[arg-type]


def load_fit(path: Path) -> FaceFit:
    """Read a fit written by `save_fit`; raises InputError for any other file."""
    require_regular(path, "fit the photo again")
    try:
        return fit_from_arrays(read_npz(path, _MOST_ARRAY_BYTES))
    except (ValueError, TypeError, KeyError, OverflowError) as error:
        raise InputError(f"{path}: not a fit written by facerf ({error}); fit the photo again") from None


def fit_to_arrays(fit: FaceFit) -> dict[str, np.ndarray]:
    """Convert a fit to named arrays for a file.

    Numbers are in single precision, because the last digits of doubles depend on memory alignment.
    """
    crop = {name: np.array(value) for name, value in asdict(fit.crop).items()}
    tensors = {name: getattr(fit, name).numpy() for name in _TENSORS}
    return {"model": np.array(fit.model), "error_iod": np.float32(fit.error_iod), **crop, **tensors}


def fit_from_arrays(arrays: Mapping[str, np.ndarray]) -> FaceFit:
    """Restore a fit from `fit_to_arrays`; raises ValueError, TypeError or KeyError for other arrays."""
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
        raise ValueError("it contains non-finite values")
    return FaceFit(str(arrays["model"]), crop, error_iod=error_iod, **tensors)
