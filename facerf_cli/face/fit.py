"""The face model fitted to 68 landmarks with strong statistical priors (paper, 'Landmark loss').

The camera is fixed; pose (rotation, translation), identity alpha and expression beta vary. Landmarks
alone constrain identity little and most of the surface not at all, so the priors are strong.
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

GOOD_ERROR_IOD, FAIR_ERROR_IOD = 0.045, 0.08  # the largest mean landmark errors of a good and of a fair fit
IOD_M = float(np.linalg.norm(np.subtract(*LANDMARKS_M[list(OUTER_EYE_CORNERS)])))
_INVISIBLE_M = 1e-4  # a shape direction that moves every landmark by less at one deviation is left out
LOST_IOD = 0.15  # landmarks with a larger mean error belong to no face or to another one
# The last bits of linear algebra depend on memory alignment. Results are rounded far above those bits and far
# below what can be measured, so that the same input gives the same bytes.
DECIMALS = 6
CROP_PX, CROP_STEP_PX = 256, 8  # side of a prepared crop, at most by default, and what divides it
_CROP_STRIDE = 5  # the pose in a crop is fitted to every fifth vertex
_LEAST_FACING = 0.1  # share of the vertices that must face the camera
_NO_OUTLIER = 1e9  # errors up to this many deviations count by their squares
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
class Heads:
    """Fitted heads of B faces in the space that their views share, float64."""

    rotation: Tensor  # [B, 3, 3], from the head frame
    translation_m: Tensor  # [B, 3]
    alpha: Tensor  # [B, Ki]
    beta: Tensor  # [B, Ke]
    off: Tensor  # [N], the mean distance of each view's trusted landmarks over the focal length

    def vertices(self, model: MorphableModel) -> Tensor:
        """The meshes [B, V, 3] in the shared space, float64."""
        vertices = model.vertices(self.alpha.float(), self.beta.float()).double()
        return vertices @ self.rotation.mT + self.translation_m[:, None]


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
) -> FaceFit:
    """Fit one face to landmarks.

    Args:
        model: The face model.
        landmarks_px: [68, 2] in the crop's pixels.
        crop: The crop, whose camera is fixed.
        settings: Weights and steps.
        trust: Weight [68] in 0..1 of each landmark.
    """
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
) -> Heads:
    """Fit B faces, each in a photo of its own, in the space of their camera.

    Args:
        model: The face model.
        landmarks_px: [B, 68, 2] in the camera's pixels.
        camera: The crops' camera.
        settings: Weights and steps.
        trust: Weight [B, 68] in 0..1 of each landmark.
    """
    target_px = torch.from_numpy(np.stack([check_landmarks(face.numpy()) for face in landmarks_px]))
    trust = torch.ones(target_px.shape[:2], dtype=torch.float64) if trust is None else trust.double()
    return fit_heads(model, views_of_photos(target_px, camera, trust), settings)


def views_of_photos(target_px: Tensor, camera: Camera, trust: Tensor) -> Views:
    """One view of each of B heads, which are in the camera's space."""
    plane = (target_px - torch.tensor([camera.cx_px, camera.cy_px], dtype=torch.float64)) / camera.focal_px
    count, here = len(plane), torch.eye(3, dtype=torch.float64)
    return Views(plane, trust, torch.arange(count), here.expand(count, -1, -1), here.new_zeros(count, 3))


def fit_heads(model: MorphableModel, views: Views, settings: FitSettings) -> Heads:
    """Fit B heads to the landmarks of N views, from three pitches, of which the least cost wins."""
    problem, alone = fit_problem(model, views, settings)
    state = least_from_pitches(problem, alone, settings.steps)
    off = (residuals(problem, state).difference.norm(dim=-1) * views.trust).sum(1) / views.trust.sum(1)
    coefficients = state.coordinates @ problem.basis.spread.mT
    alpha, beta = coefficients[:, : len(model.identity)], coefficients[:, len(model.identity) :]
    return Heads(state.rotation, state.translation_m, alpha, beta, off)


def fit_problem(model: MorphableModel, views: Views, settings: FitSettings) -> tuple[Problem, FitState]:
    """Pose the problem of N views, and place the head of each by its landmarks alone [N]."""
    basis = fit_basis(model, settings)
    alone, scale = weak_perspective(basis, views)
    noise = torch.full((68,), settings.noise_inner, dtype=torch.float64)  # of the inter-ocular distance
    noise[list(CONTOUR)] = settings.noise_contour
    inverse_noise = views.trust.sqrt() / (noise * (IOD_M * scale)[:, None])
    return Problem(basis, views, inverse_noise, settings.huber), alone


def fit_views(
    model: MorphableModel, cameras: Sequence[PosedCamera], landmarks_px: Sequence[np.ndarray | None]
) -> tuple[Heads, np.ndarray]:
    """Fit one head in the world to landmarks [68, 2] in the pixels of W calibrated cameras.

    A camera without a face has None. Landmarks that the other cameras contradict (`LOST_IOD`) are left out.
    Returns the head, and for each camera the mean distance [W] of its trusted landmarks over the inter-ocular
    distance of a frontal face, NaN without landmarks. Raises InputError where no camera has landmarks.
    """
    views = [(index, cameras[index], px) for index, px in enumerate(landmarks_px) if px is not None]
    if not views:
        raise InputError("no camera shows a face; give frames from the front of the subject")
    while True:
        head = _head_in_world(model, [(camera, px) for _, camera, px in views])
        turn = torch.stack([camera.rotation for _, camera, _ in views])
        shift_m = torch.stack([camera.translation_m for _, camera, _ in views])
        depth_m = eyes_depth_m(turn @ head.rotation, turn @ head.translation_m[0] + shift_m)
        off_iod = (head.off * depth_m / IOD_M).round(decimals=DECIMALS).tolist()
        limit = max(LOST_IOD, min(off_iod))
        kept = [view for view, off in zip(views, off_iod, strict=True) if off <= limit]
        if len(kept) == len(views):
            errors_iod = np.full(len(cameras), np.nan)
            errors_iod[[index for index, *_ in views]] = off_iod
            return head, errors_iod
        views = kept


def _head_in_world(model: MorphableModel, seen: Sequence[tuple[PosedCamera, np.ndarray]]) -> Heads:
    """Fit one head in the first camera's space, so that the fit does not depend on the world's axes."""
    plane = torch.stack([camera.to_plane(torch.from_numpy(check_landmarks(px))) for camera, px in seen])
    crops = [from_landmarks(px, CROP_PX) for _, px in seen]
    trust = [
        trust_inside(crop.to_crop(px), crop, camera.height_px, camera.width_px)
        for crop, (camera, px) in zip(crops, seen, strict=True)
    ]
    first = seen[0][0]
    turn = torch.stack([camera.rotation for camera, _ in seen]) @ first.rotation.mT
    shift_m = torch.stack([camera.translation_m for camera, _ in seen]) - turn @ first.translation_m
    of_one = torch.zeros(len(seen), dtype=torch.int64)
    views = Views(plane, torch.from_numpy(np.stack(trust)), of_one, turn, shift_m)
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
    """The depth of the eyes along the camera's axis [...] for poses [..., 3, 3] and [..., 3]."""
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
    """Pose the head in the fixed camera of its crop from a camera's image; keep identity and expression.

    The crop follows the fitted landmarks. The pose brings the vertices that face the camera as close as
    possible to their pixels in the true camera. The second result is the mean distance that remains, over the
    inter-ocular distance.

    Args:
        model: The face model.
        head: That of `fit_views`.
        camera: The true camera.
        landmarks_px: [68, 2] in its image; without them the fit stores the fitted landmarks.
        error_iod: Error of the joint fit in this camera, over the inter-ocular distance.
        crop_px: Side of the crop; None: `CROP_PX`, or less where the camera's image has fewer pixels there.

    Raises:
        InputError: The camera sees the head from behind.
    """
    vertices_world = head.vertices(model)[0]
    fitted_px = camera.project(model.landmarks(vertices_world[None])[0]).numpy()
    crop = from_landmarks(fitted_px, crop_px or CROP_PX)
    places = {key: round(getattr(crop, key), DECIMALS) for key in ("x0_px", "y0_px", "side_px")}
    crop = replace(crop, **places)
    if crop_px is None:
        own_px = int(crop.side_px) // CROP_STEP_PX * CROP_STEP_PX
        crop = replace(crop, size_px=min(crop.size_px, max(own_px, CROP_STEP_PX)))
    in_camera = vertices_world @ camera.rotation.mT + camera.translation_m
    triangles = grid_triangles()
    facing = torch.unique(triangles[front_facing(in_camera, triangles)])
    if len(facing) < _LEAST_FACING * len(in_camera):
        raise InputError("a camera sees the head from behind")
    ids = facing[::_CROP_STRIDE]
    target_px = torch.from_numpy(crop.to_crop(camera.project(vertices_world[ids]).numpy()))
    points = (vertices_world[ids] - head.translation_m) @ head.rotation[0]
    rigid = FitBasis(points, points.new_zeros(*points.shape, 0), points.new_zeros(0, 0), points[:0])
    even = torch.ones_like(target_px[None, :, 0])
    views = views_of_photos(target_px[None], crop.camera, even)
    problem = Problem(rigid, views, even, _NO_OUTLIER)
    pose = least_from_pitches(problem, weak_perspective(rigid, views)[0], FitSettings().steps)
    off = residuals(problem, pose).difference.norm(dim=-1).mean()
    seen_px = np.round(fitted_px, DECIMALS) if landmarks_px is None else landmarks_px
    fit = FaceFit(
        model=model.name,
        crop=crop,
        rotation=pose.rotation[0].round(decimals=DECIMALS + 1).float(),
        translation_m=pose.translation_m[0].round(decimals=DECIMALS).float(),
        alpha=head.alpha[0].float(),
        beta=head.beta[0].float(),
        landmarks_px=torch.from_numpy(crop.to_crop(seen_px)).float(),
        error_iod=error_iod,
    )
    return fit, float(off * eyes_depth_m(pose.rotation[0], pose.translation_m[0]) / IOD_M)


@lru_cache(maxsize=4)
def fit_basis(model: MorphableModel, settings: FitSettings) -> FitBasis:
    """The model at the points of a fit, with the settings' priors; cached by model and settings."""
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
    """The modes [N, 3, Q] at N points of the mesh and the spread [K, Q] of their coordinates."""
    modes = torch.cat([model.identity[:, corners], model.expression[:, corners]]).double()  # [K, N, 3, 3]
    stds = torch.full((len(modes),), settings.expression_std, dtype=torch.float64)
    stds[: len(model.identity)] = settings.identity_std
    whitened = torch.einsum("k,nc,kncx->nxk", stds, weights, modes)
    turn = torch.linalg.svd(whitened.flatten(0, 1), full_matrices=False).Vh.mT
    turned = whitened @ turn
    visible = turned.norm(dim=1).amax(0) > _INVISIBLE_M
    return turned[..., visible], stds[:, None] * turn[:, visible]


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
