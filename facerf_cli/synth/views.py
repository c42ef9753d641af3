"""Photos of heads with random cameras, fitted with the errors of a landmark detector.

Noisy landmarks give the crop and the fit of each photo, as in the pipeline. Unwrapping an image of the true
(u, v) then gives the warp: the true texel that each texel of the fitted UV map shows.
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

_PHOTO_SIDE_PX = 1000
_FACE_SIDE_M = 0.26  # approximate side of the square of a crop, at the face
_FOCALS = (1.6, 6.0)  # range of focal lengths, in sides of the photo
_FACE_SHARES = (0.3, 0.8)  # range of the side of the crop, in sides of the photo
_LEAST_COVER = 0.9  # share of a texel that must show the face to be visible
# Landmarks of contour, brows, nose, eyes and mouth, whose errors have a common part.
_GROUPS = (
    slice(0, 17),
    slice(17, 22),
    slice(22, 27),
    slice(27, 36),
    slice(36, 42),
    slice(42, 48),
    slice(48, 68),
)


@dataclass(frozen=True)
class ViewSettings:
    """Standard deviations of the pose, and of landmark errors in units of the inter-ocular distance."""

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
    """Photograph one head [V, 3] (head frame) `count` times, and fit the photos with a face model.

    Returns rotation [W, 3, 3], the true head_to_camera; warp [W, 2, T, T] half, the true (u, v) of every
    fitted texel; visible [W, T, T] bytes; normals [W, 3, T, T] half, of the fit, camera space.
    """
    random = np.random.default_rng([seed, 1])
    photos = [photograph_head(vertices, random, settings) for _ in range(count)]
    landmarks = torch.stack([photo.landmarks_px for photo in photos])
    fits = fit_batch(fitted_with, landmarks, crop_camera(settings.crop_px))
    triangles = grid_triangles()
    views = []
    for photo, fitted_camera in zip(photos, fits.vertices_camera(fitted_with), strict=True):
        image, camera = _uv_image(photo), crop_camera(settings.crop_px)
        texture, visible = unwrap(image, fitted_camera.float(), triangles, camera, side)
        on_face = texture[2].clamp_min(1e-6)
        seen = visible * (texture[2] > _LEAST_COVER)
        warp = _fill_warp(texture[:2] / on_face, seen)
        views.append(
            (
                photo.rotation,
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
class HeadPhoto:
    """A head in front of a camera, cropped by noisy landmarks."""

    vertices_camera: Tensor  # [V, 3]
    rotation: Tensor  # [3, 3] head_to_camera
    camera: Camera  # of the crop, with the true focal length and principal point
    landmarks_px: Tensor  # [68, 2] in the crop, with the errors of a detector


def photograph_head(vertices: Tensor, random: np.random.Generator, settings: ViewSettings) -> HeadPhoto:
    """Take one random photo of a head [V, 3] (head frame)."""
    frontal = random.random() < settings.frontal_share
    spread = np.array([settings.yaw_deg, settings.pitch_deg, settings.roll_deg]) * (0.3 if frontal else 1.0)
    pose = np.clip(random.normal(0, spread), -settings.limit_deg, settings.limit_deg)
    rotation = pose_to_rotation(*(float(angle) for angle in pose))
    focal_px = _PHOTO_SIDE_PX * float(np.exp(random.uniform(*np.log(_FOCALS))))
    side_px = _PHOTO_SIDE_PX * random.uniform(*_FACE_SHARES)
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
    return HeadPhoto(vertices_camera, rotation, camera, in_crop)


def _detected(landmarks_px: Tensor, random: np.random.Generator, settings: ViewSettings) -> Tensor:
    """Add the errors of a detector to landmarks [68, 2]: one per point, and one per part of the face."""
    eyes = landmarks_px[list(OUTER_EYE_CORNERS)]
    unit_px = float((eyes[0] - eyes[1]).norm())
    error = random.normal(0, settings.point_noise, (68, 2))
    for group in _GROUPS:
        error[group] += random.normal(0, settings.group_noise, 2)
    error[list(CONTOUR)] += random.normal(0, settings.contour_noise, (len(CONTOUR), 2))
    return landmarks_px + torch.from_numpy(error).float() * unit_px


def _uv_image(photo: HeadPhoto) -> Tensor:
    """Render (u, v, 1) of the true surface [3, H, W], zero off the face."""
    triangles = grid_triangles()
    fragments = rasterize(photo.vertices_camera, triangles, photo.camera)
    attributes = torch.cat([grid_uv(), torch.ones(GRID * GRID, 1)], -1)
    image = interpolate(attributes, triangles, fragments) * fragments.covered[..., None]
    return image.permute(2, 0, 1)


def _fill_warp(warp: Tensor, seen: Tensor) -> Tensor:
    """Fill in the warp [2, T, T] of invisible texels from the offsets of their neighbours."""
    identity = texel_centres_uv(warp.shape[-1]).permute(2, 0, 1)
    return identity + inpaint((warp - identity) * (seen > 0), (seen > 0.3).float())
