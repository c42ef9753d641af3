"""One head fitted to the landmarks of several calibrated cameras, and that head in the crops of their images.

`fit_views`: the cameras share identity, expression and the head's place in the world; each camera adds the
residuals of its 68 landmarks, whose contour slides along the silhouette in this camera (`gauss_newton.py`).
Priors and noise are those of single fits (`fit.py`). The world is the calibration's, in metres, right-handed.

`fit_in_crop`: the fixed camera of a crop has a focal length of 4 times the crop's side (`raster/camera.py`),
so a face that fills the crop stands 0.9 to 1.05 m in front of it, wherever the true camera was. No pose
removes this difference in perspective. At the best pose the mean distance of the vertices, as a share of the
inter-ocular distance, is 0.1 to 0.6 % for cameras at 0.8 to 1.1 m, up to 0.6 % at 1.3 m, 0.8 % at 1.5 m,
1.1 % at 2 m and 1.7 % far away (heads of tests/face/test_joint_fit.py). More steps do not lower it; weights
that minimise the mean distance lower it by a twentieth.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from facerf_cli.errors import InputError
from facerf_cli.face.crop import check_landmarks, from_landmarks
from facerf_cli.face.fit import IOD_M, FaceFit, FitSettings, fit_basis, landmark_noise, trust_inside
from facerf_cli.face.gauss_newton import (
    FitState,
    Problem,
    Residuals,
    apply_step,
    damped_step,
    descend,
    jacobian,
    landmark_cost,
    normal_equations,
    pixels_by_points,
    pixels_by_pose,
    prior_cost,
    residuals,
    weak_perspective,
)
from facerf_cli.face.morphable import MorphableModel
from facerf_cli.face.topology import LANDMARKS_M, OUTER_EYE_CORNERS, grid_triangles
from facerf_cli.raster.camera import Camera, pixel_rays, project
from facerf_cli.raster.rasterize import front_facing

LOST_IOD = 0.15  # landmarks with a larger mean error belong to no face or to another one
# The last bits of linear algebra depend on memory alignment. Results are rounded far above those bits and far
# below what can be measured, so that the same input gives the same bytes.
DECIMALS = 6
_UNIT_CAMERA = Camera(1.0, 0, 0, 0.0, 0.0)  # the landmarks of all cameras are converted to its image
_SETTINGS = FitSettings()
_CROP_STEPS = 12
_CROP_STRIDE = 5  # the pose in a crop is fitted to every fifth vertex
_LEAST_FACING = 0.1  # share of the vertices that must face the camera


@dataclass(frozen=True, eq=False)
class PosedCamera:
    """A calibrated pinhole camera in the world; camera space as in `raster/camera.py`, float64."""

    focal_px: tuple[float, float]  # along x and along y
    centre_px: tuple[float, float]
    width_px: int
    height_px: int
    rotation: Tensor  # [3, 3] world to camera
    translation_m: Tensor  # [3] world to camera

    def project(self, points_world: Tensor) -> Tensor:
        """Project world points [..., 3] to the image's pixels [..., 2], float64."""
        points_camera = points_world.double() @ self.rotation.mT + self.translation_m
        focal, centre = torch.tensor([self.focal_px, self.centre_px], dtype=torch.float64)
        return project(points_camera, _UNIT_CAMERA) * focal + centre

    def to_plane(self, px: Tensor) -> Tensor:
        """Convert pixels [..., 2] to the image of a camera of focal length 1, centred at 0."""
        focal, centre = torch.tensor([self.focal_px, self.centre_px], dtype=torch.float64)
        return (px - centre) / focal


@dataclass(frozen=True, eq=False)
class JointFit:
    """A head in the world, float64."""

    rotation: Tensor  # [3, 3], head to world
    translation_m: Tensor  # [3]
    alpha: Tensor  # [Ki]
    beta: Tensor  # [Ke]
    error_iod: tuple[float | None, ...]  # of each camera, see `fit_views`; None without landmarks

    @property
    def mean_error_iod(self) -> float:
        """The mean error over the cameras that have landmarks."""
        errors = [error for error in self.error_iod if error is not None]
        return round(float(np.mean(errors)), DECIMALS)

    def vertices_world(self, model: MorphableModel) -> Tensor:
        """The mesh in the world [V, 3], float64."""
        vertices = model.vertices(self.alpha[None].float(), self.beta[None].float())[0]
        return vertices.double() @ self.rotation.mT + self.translation_m


@dataclass(frozen=True, eq=False)
class _Joint:
    """The problem of one head in W cameras; the head's pose is in the space of a reference camera.

    States of the head are batches of one; the cameras' landmarks are the rows of `problem`.
    """

    problem: Problem
    turn: Tensor  # [W, 3, 3], reference camera to each camera
    shift_m: Tensor  # [W, 3]

    @staticmethod
    def seen_from(reference: PosedCamera, cameras: Sequence[PosedCamera], problem: Problem) -> "_Joint":
        turn = torch.stack([camera.rotation for camera in cameras]) @ reference.rotation.mT
        shift_m = torch.stack([camera.translation_m for camera in cameras]) - turn @ reference.translation_m
        return _Joint(problem, turn, shift_m)

    def views(self, head: FitState) -> FitState:
        """The head in the space of each camera [W]."""
        place = self.turn @ head.translation_m[0] + self.shift_m
        return FitState(self.turn @ head.rotation, place, head.coordinates.expand(len(place), -1))

    def residuals(self, head: FitState) -> Residuals:
        return residuals(self.problem, self.views(head))

    def cost(self, head: FitState, at: Residuals) -> Tensor:
        return landmark_cost(self.problem, at).sum(0, keepdim=True) + prior_cost(head)

    def step(self, head: FitState, at: Residuals, damping: Tensor) -> Tensor:
        views = self.views(head)
        by_view = jacobian(self.problem, views, at)  # [W, 68, 2, 6 + Q]
        depths = head.translation_m[0, 2] / views.translation_m[:, 2]  # `apply_step` shifts in units of depth
        by_omega = by_view[..., :3] @ self.turn[:, None]
        by_shift = by_view[..., 3:6] @ (self.turn * depths[:, None, None])[:, None]
        by_head = torch.cat([by_omega, by_shift, by_view[..., 6:]], -1)
        normal, gradient = normal_equations(self.problem, by_head, at)
        return damped_step(normal.sum(0, True), gradient.sum(0, True), head.coordinates, damping)


def fit_views(
    model: MorphableModel,
    cameras: Sequence[PosedCamera],
    landmarks_px: Sequence[np.ndarray | None],
    settings: FitSettings = _SETTINGS,
) -> JointFit:
    """Fit one head to landmarks [68, 2] in the pixels of each camera; None for a camera without a face.

    Landmarks that the other cameras contradict (`LOST_IOD`) are left out; their error in the result is None.
    An error is the mean distance of the trusted landmarks over the inter-ocular distance of a frontal face.
    Raises InputError where no camera has landmarks.
    """
    views = [(index, cameras[index], px) for index, px in enumerate(landmarks_px) if px is not None]
    if not views:
        raise InputError("no camera shows a face; give frames from the front of the subject")
    while True:
        joint, errors = _fit_found(model, [view[1] for view in views], [view[2] for view in views], settings)
        limit = max(LOST_IOD, min(errors))
        kept = [view for view, error in zip(views, errors, strict=True) if error <= limit]
        if len(kept) == len(views):
            by_index = {view[0]: error for view, error in zip(views, errors, strict=True)}
            return replace(joint, error_iod=tuple(by_index.get(index) for index in range(len(cameras))))
        views = kept


def _fit_found(
    model: MorphableModel,
    cameras: list[PosedCamera],
    landmarks_px: list[np.ndarray],
    settings: FitSettings,
) -> tuple[JointFit, list[float]]:
    """Fit W cameras that all have landmarks: the fit without its errors, and the errors [W]."""
    basis = fit_basis(model, settings)
    pairs = list(zip(cameras, landmarks_px, strict=True))
    target = torch.stack([camera.to_plane(torch.from_numpy(check_landmarks(px))) for camera, px in pairs])
    trust = torch.from_numpy(np.stack([_trust(camera, px) for camera, px in pairs]))
    alone, scale = weak_perspective(basis, target, _UNIT_CAMERA)
    noise = landmark_noise(settings) * (IOD_M * scale)[:, None]
    problem = Problem(basis, target, _UNIT_CAMERA, trust.sqrt() / noise, settings.huber)
    # Each camera alone gives a start, in its own space; the one of least cost over all cameras is taken.
    parts = (alone.rotation, alone.translation_m, alone.coordinates)
    states = [FitState(*(part[i : i + 1] for part in parts)) for i in range(len(cameras))]
    starts = [
        (_Joint.seen_from(camera, cameras, problem), state)
        for camera, state in zip(cameras, states, strict=True)
    ]
    costs = torch.cat([joint.cost(head, joint.residuals(head)) for joint, head in starts])
    first = int(costs.nan_to_num(nan=torch.inf).argmin())
    joint, head = starts[first]
    head = descend(joint.residuals, joint.cost, joint.step, head, settings.steps)
    off = (joint.residuals(head).difference_px.norm(dim=-1) * trust).sum(1) / trust.sum(1)  # [W]
    views = joint.views(head)
    errors_iod = off * eyes_depth_m(views.rotation, views.translation_m) / IOD_M
    coefficients = (head.coordinates @ basis.spread.mT)[0]
    to_world = cameras[first].rotation.mT
    fit = JointFit(
        rotation=(to_world @ head.rotation[0]).round(decimals=DECIMALS + 1),
        translation_m=(to_world @ (head.translation_m[0] - cameras[first].translation_m)).round(
            decimals=DECIMALS
        ),
        alpha=coefficients[: len(model.identity)].round(decimals=DECIMALS),
        beta=coefficients[len(model.identity) :].round(decimals=DECIMALS),
        error_iod=(),
    )
    return fit, errors_iod.round(decimals=DECIMALS).tolist()


def eyes_depth_m(rotation: Tensor, translation_m: Tensor) -> Tensor:
    """The depth of the eyes along the camera's axis [...] for poses [..., 3, 3] and [..., 3]."""
    eyes = torch.from_numpy(LANDMARKS_M[list(OUTER_EYE_CORNERS)].mean(0))
    return -(rotation @ eyes + translation_m)[..., 2]


def _trust(camera: PosedCamera, landmarks_px: np.ndarray) -> np.ndarray:
    crop = from_landmarks(landmarks_px, 256)
    return trust_inside(crop.to_crop(landmarks_px), crop, camera.height_px, camera.width_px)


CROP_PX, CROP_STEP_PX = 256, 8  # side of a prepared crop, at most by default, and what divides it


def fit_in_crop(
    model: MorphableModel,
    joint: JointFit,
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
        joint: The fit of all cameras.
        camera: The true camera.
        landmarks_px: [68, 2] in its image; without them the fit stores the fitted landmarks.
        error_iod: Error of the joint fit in this camera, over the inter-ocular distance.
        crop_px: Side of the crop; None: `CROP_PX`, or less where the camera's image has fewer pixels there.

    Raises:
        InputError: The camera sees the head from behind.
    """
    vertices_world = joint.vertices_world(model)
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
    head = (vertices_world[ids] - joint.translation_m) @ joint.rotation
    rotation, translation_m = _pose_in_crop(head, target_px, camera.rotation @ joint.rotation, crop.camera)
    off_px = (project(head @ rotation.mT + translation_m, crop.camera) - target_px).norm(dim=-1).mean()
    seen_px = np.round(fitted_px, DECIMALS) if landmarks_px is None else landmarks_px
    fit = FaceFit(
        model=model.name,
        crop=crop,
        rotation=rotation.round(decimals=DECIMALS + 1).float(),
        translation_m=translation_m.round(decimals=DECIMALS).float(),
        alpha=joint.alpha.float(),
        beta=joint.beta.float(),
        landmarks_px=torch.from_numpy(crop.to_crop(seen_px)).float(),
        error_iod=error_iod,
    )
    iod_px = crop.camera.focal_px * IOD_M / eyes_depth_m(rotation, translation_m)
    return fit, float(off_px / iod_px)


def _pose_in_crop(head: Tensor, target_px: Tensor, rotation: Tensor, camera: Camera) -> tuple[Tensor, Tensor]:
    """Rotation [3, 3] and translation [3] that bring points [N, 3] closest to pixels [N, 2]; Gauss-Newton.

    The rotation is a first guess; the first translation puts the points' mean on the pixels' mean.
    """
    ray = pixel_rays(target_px.mean(0), camera)
    spread_px = (target_px - target_px.mean(0)).norm(dim=-1).mean()
    spread_m = ((head - head.mean(0)) @ rotation.mT)[:, :2].norm(dim=-1).mean()
    place = ray * (camera.focal_px * spread_m / spread_px) - rotation @ head.mean(0)
    state = FitState(rotation[None], place[None], torch.zeros(1, 0, dtype=torch.float64))
    for _ in range(_CROP_STEPS):
        points = head @ state.rotation.mT + state.translation_m[:, None]
        by_pose = pixels_by_pose(pixels_by_points(points, camera), points, state.translation_m)[0]
        off_px = project(points, camera)[0] - target_px
        state = apply_step(state, -torch.linalg.lstsq(by_pose.flatten(0, 1), off_px.flatten()).solution[None])
    return state.rotation[0], state.translation_m[0]
