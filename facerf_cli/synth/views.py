"""A camera of the synthetic stage.

Heads seen and fitted as the pipeline sees and fits photos: the misfit half of the training bank.

A random camera photographs the head; noisy landmarks give the crop and the fit; unwrapping a picture of the
true (u, v) then tells which true texel every fitted texel will show.
"""

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from facerf_cli.face.crop import from_landmarks
from facerf_cli.face.fit import fit_batch
from facerf_cli.face.morphable import MorphableModel
from facerf_cli.face.topology import (
    CONTOUR,
    GRID,
    OUTER_EYE_CORNERS,
    grid_triangles,
    grid_uv,
    landmark_weights,
)
from facerf_cli.raster.camera import Camera, crop_camera, pose_to_rotation, project
from facerf_cli.raster.rasterize import interpolate, rasterize
from facerf_cli.raster.texture import inpaint, normal_map, texel_centres_uv, unwrap


@dataclass(frozen=True, eq=False)
class StageCamera:
    """A camera and where it stands: p_camera = head_to_camera [3, 3] @ p_head + translation_m [3]."""

    camera: Camera
    head_to_camera: Tensor
    translation_m: Tensor


_PHOTO_SIDE_PX = 1000
_FACE_SIDE_M = 0.26  # of the square that a crop takes, roughly


@dataclass(frozen=True)
class ViewSettings:
    """Spread of the pose, and of the landmark detector's errors as shares of the inter-ocular distance."""

    crop_px: int = 256
    yaw_deg: float = 20.0
    pitch_deg: float = 9.0
    roll_deg: float = 7.0
    frontal_share: float = 0.45
    limit_deg: float = 48.0
    point_noise: float = 0.014
    group_noise: float = 0.012
    contour_noise: float = 0.03


def build_views(
    vertices: Tensor,
    fitted_with: MorphableModel,
    count: int,
    side: int,
    seed: int,
    settings: ViewSettings = ViewSettings(),
) -> dict[str, Tensor]:
    """`count` views of one head [V, 3] (head frame), fitted with another model.

    Returns rotation [W, 3, 3] head_to_camera of the truth; warp [W, 2, T, T] half, the true (u, v) of every
    fitted texel; visible [W, T, T] bytes; normals [W, 3, T, T] half, camera-space, of the fit.
    """
    random = np.random.default_rng([seed, 1])
    shots = [photograph_head(vertices, random, settings) for _ in range(count)]
    landmarks = torch.stack([shot.landmarks_px for shot in shots])
    fits = fit_batch(fitted_with, landmarks, crop_camera(settings.crop_px))
    triangles = grid_triangles()
    views = []
    for shot, fitted_camera in zip(shots, fits.vertices_camera(fitted_with), strict=True):
        image, camera = _uv_image(shot), crop_camera(settings.crop_px)
        texture, visible = unwrap(image, fitted_camera.float(), triangles, camera, side)
        on_face = texture[2].clamp_min(1e-6)
        seen = visible * (texture[2] > 0.9)
        warp = _fill_warp(texture[:2] / on_face, seen)
        views.append(
            (
                shot.rotation,
                warp.half(),
                (seen * 255).round().byte(),
                normal_map(fitted_camera.float(), triangles, side).half(),
            )
        )
    return {
        name: torch.stack(list(column)).contiguous()
        for name, column in zip(
            ("rotation", "warp", "visible", "normals"), zip(*views, strict=True), strict=True
        )
    }


@dataclass(frozen=True)
class Shot:
    """A head in camera space [V, 3] and what a crop by noisy landmarks makes of it."""

    vertices_camera: Tensor
    rotation: Tensor
    camera: Camera  # of the crop: the photo's own focal length and principal point
    landmarks_px: Tensor  # [68, 2], in the crop, with a detector's errors


def photograph_head(vertices: Tensor, random: np.random.Generator, settings: ViewSettings) -> Shot:
    """One random photograph of a head [V, 3] (head frame)."""
    frontal = random.random() < settings.frontal_share
    spread = np.array([settings.yaw_deg, settings.pitch_deg, settings.roll_deg]) * (0.3 if frontal else 1.0)
    pose = np.clip(random.normal(0, spread), -settings.limit_deg, settings.limit_deg)
    rotation = pose_to_rotation(*(float(angle) for angle in pose))
    focal_px = _PHOTO_SIDE_PX * float(np.exp(random.uniform(np.log(1.6), np.log(6.0))))
    side_px = _PHOTO_SIDE_PX * random.uniform(0.3, 0.8)
    distance_m = focal_px * _FACE_SIDE_M / side_px
    centre_m = torch.tensor(
        [*(random.uniform(-0.1, 0.1, 2) * distance_m * _PHOTO_SIDE_PX / focal_px), -distance_m]
    )
    vertices_camera = vertices @ rotation.T + centre_m.float()
    photo = Camera(focal_px, _PHOTO_SIDE_PX, _PHOTO_SIDE_PX, _PHOTO_SIDE_PX / 2, _PHOTO_SIDE_PX / 2)
    corners, weights = landmark_weights()
    landmarks_px = project((vertices_camera[corners] * weights[..., None]).sum(1), photo)
    landmarks_px = _detected(landmarks_px, random, settings)
    crop = from_landmarks(landmarks_px.numpy(), settings.crop_px)
    scale = crop.size_px / crop.side_px
    camera = Camera(
        focal_px * scale,
        crop.size_px,
        crop.size_px,
        (photo.cx_px - crop.x0_px) * scale,
        (photo.cy_px - crop.y0_px) * scale,
    )
    in_crop = torch.as_tensor(crop.to_crop(landmarks_px.numpy()), dtype=torch.float32)
    return Shot(vertices_camera, rotation, camera, in_crop)


def _detected(landmarks_px: Tensor, random: np.random.Generator, settings: ViewSettings) -> Tensor:
    """Landmarks [68, 2] with a detector's errors: each point's own, and one for each part of the face."""
    eyes = landmarks_px[list(OUTER_EYE_CORNERS)]
    unit_px = float((eyes[0] - eyes[1]).norm())
    error = random.normal(0, settings.point_noise, (68, 2))
    for part in (
        slice(0, 17),
        slice(17, 22),
        slice(22, 27),
        slice(27, 36),
        slice(36, 42),
        slice(42, 48),
        slice(48, 68),
    ):
        error[part] += random.normal(0, settings.group_noise, 2)
    error[list(CONTOUR)] += random.normal(0, settings.contour_noise, (len(CONTOUR), 2))
    return landmarks_px + torch.from_numpy(error).float() * unit_px


def _uv_image(shot: Shot) -> Tensor:
    """(u, v, 1) of the true surface [3, H, W], zero off the face."""
    triangles = grid_triangles()
    fragments = rasterize(shot.vertices_camera, triangles, shot.camera)
    attributes = torch.cat([grid_uv(), torch.ones(GRID * GRID, 1)], -1)
    image = interpolate(attributes, triangles, fragments) * fragments.covered[..., None]
    return image.permute(2, 0, 1)


def _fill_warp(warp: Tensor, seen: Tensor) -> Tensor:
    """The warp [2, T, T] with the offsets of unseen texels filled in from their neighbours."""
    own = texel_centres_uv(warp.shape[-1]).permute(2, 0, 1)
    return own + inpaint((warp - own) * (seen > 0), (seen > 0.3).float())
