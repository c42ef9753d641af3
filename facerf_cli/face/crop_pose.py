"""A head in the world as the fixed camera of a crop sees it.

That camera's focal length is 4 times the crop's side (`raster/camera.py`), so a face that fills the crop
stands 0.9 to 1.05 m before it, wherever the true camera stood. No pose takes back the difference of
perspective. Of the inter-ocular distance, the mean distance of vertices left at the best pose is 0.1 to 0.6 %
for cameras at 0.8 to 1.1 m, up to 0.6 % at 1.3 m, 0.8 % at 1.5 m, 1.1 % at 2 m and 1.7 % far away (heads of
tests/face/test_joint_fit.py). More steps change none of it, weights for the least mean distance a twentieth.
"""

import numpy as np
import torch
from torch import Tensor

from facerf_cli.errors import InputError
from facerf_cli.face.crop import Crop, from_landmarks
from facerf_cli.face.fit import IOD_M, FaceFit
from facerf_cli.face.gauss_newton import FitState, moved, pixels_by_points, pixels_by_pose
from facerf_cli.face.joint_fit import DECIMALS, JointFit, PosedCamera, eyes_depth_m
from facerf_cli.face.morphable import MorphableModel
from facerf_cli.face.topology import grid_triangles
from facerf_cli.raster.camera import Camera, pixel_rays, project
from facerf_cli.raster.rasterize import front_facing

_STEPS = 12
_STRIDE = 5  # every so many vertices hold the pose
_LEAST_SHARE = 0.1  # of the vertices that must face the camera


def fit_in_crop(
    model: MorphableModel,
    joint: JointFit,
    camera: PosedCamera,
    landmarks_px: np.ndarray | None,
    error_iod: float,
    crop_px: int,
) -> tuple[FaceFit, float]:
    """The head in the fixed camera of its crop from a camera's picture, identity and expression unchanged.

    The crop goes by the fitted landmarks. The pose is the one under which the vertices that face the camera
    lie where the true camera sees them; the mean distance that is left, over the inter-ocular distance, comes
    second. `landmarks_px` None takes the fitted ones.
    """
    vertices_world = joint.vertices_world(model)
    fitted_px = camera.project(model.landmarks(vertices_world[None])[0]).numpy()
    crop = _rounded(from_landmarks(fitted_px, crop_px))
    in_camera = vertices_world @ camera.rotation.mT + camera.translation_m
    facing = _facing(in_camera)
    if len(facing) < _LEAST_SHARE * len(in_camera):
        raise InputError("a camera sees the head from behind")
    ids = facing[::_STRIDE]
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


def _rounded(crop: Crop) -> Crop:
    x0_px, y0_px, side_px = (round(length, DECIMALS) for length in (crop.x0_px, crop.y0_px, crop.side_px))
    return Crop(x0_px, y0_px, side_px, crop.size_px)


def _facing(vertices_camera: Tensor) -> Tensor:
    """Ids of the vertices of triangles that face the camera."""
    triangles = grid_triangles()
    return torch.unique(triangles[front_facing(vertices_camera, triangles)])


def _pose_in_crop(head: Tensor, target_px: Tensor, rotation: Tensor, camera: Camera) -> tuple[Tensor, Tensor]:
    """Rotation [3, 3] and translation [3] that bring points [N, 3] closest to pixels [N, 2]; Gauss-Newton.

    It begins with a rotation in a camera that looks elsewhere, and with the points where their mean is seen.
    """
    ray = pixel_rays(target_px.mean(0), camera)
    spread_px = (target_px - target_px.mean(0)).norm(dim=-1).mean()
    spread_m = ((head - head.mean(0)) @ rotation.mT)[:, :2].norm(dim=-1).mean()
    place = ray * (camera.focal_px * spread_m / spread_px) - rotation @ head.mean(0)
    state = FitState(rotation[None], place[None], torch.zeros(1, 0, dtype=torch.float64))
    for _ in range(_STEPS):
        points = head @ state.rotation.mT + state.translation_m[:, None]
        by_pose = pixels_by_pose(pixels_by_points(points, camera), points, state.translation_m)[0]
        off_px = project(points, camera)[0] - target_px
        state = moved(state, -torch.linalg.lstsq(by_pose.flatten(0, 1), off_px.flatten()).solution[None])
    return state.rotation[0], state.translation_m[0]
