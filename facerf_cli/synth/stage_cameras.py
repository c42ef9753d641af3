"""Cameras of the synthetic light stage."""

from dataclasses import dataclass
from functools import lru_cache
from typing import Literal

import torch
from torch import Tensor

from facerf_cli.raster.camera import Camera, pose_to_rotation

CAMERA_DISTANCE_M = 1.2  # from the head
Frame = Literal["head", "bust"]
# Height that an image shows at that distance, and height of its middle over the origin of the head frame.
_FRAMES_M: dict[Frame, tuple[float, float]] = {"head": (0.36, 0.0), "bust": (0.56, -0.06)}
# Azimuth and elevation of the cameras seen from the head, all in front (paper, 'Dataset').
_CAMERAS_DEG = ((0, 0), (-18, 6), (18, -6), (-36, -4), (36, 4), (-54, 3), (54, -3), (0, 24))


@dataclass(frozen=True, eq=False)
class StageCamera:
    """A camera and its pose: p_camera = head_to_camera [3, 3] @ p_head + translation_m [3]."""

    camera: Camera
    head_to_camera: Tensor
    translation_m: Tensor


@lru_cache(maxsize=4)
def stage_cameras(size_px: int, frame: Frame = "head") -> tuple[StageCamera, ...]:
    """Build the eight cameras; world axes are those of a head that looks into the first camera."""
    high_m, middle_m = _FRAMES_M[frame]
    camera = Camera(size_px * CAMERA_DISTANCE_M / high_m, size_px, size_px, size_px / 2, size_px / 2)
    return tuple(
        StageCamera(
            camera, pose_to_rotation(-azimuth, elevation, 0), torch.tensor([0, -middle_m, -CAMERA_DISTANCE_M])
        )
        for azimuth, elevation in _CAMERAS_DEG
    )
