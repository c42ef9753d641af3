"""Head motion undone: the shifts that take each frame back to where the others have the head.

First on coarse frames, which see far; then on finer ones. What is found is good to about a quarter of a fine
pixel, so shorter shifts are left alone. Lamps from the side and from behind tell too little of the head's
place; their frames stay as they are.
"""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import torch
import torch.nn.functional as F
from scipy import ndimage

from facerf_cli.stage.checks.frames import CameraFrames, read_frames
from facerf_cli.stage.checks.motion import measure_motion
from facerf_cli.stage.checks.stereo import fit_stereo
from facerf_cli.stage.data.layouts import Capture

_FINE_PX, _COARSER = 192, 2  # the longer side of the fine frames; fine pixels to a coarse one
_NOISE_PX = 0.3  # of a fine pixel


def with_alignment(capture: Capture, subject: str, broken: Mapping[str, set[str]]) -> Capture:
    """The capture, its frames of a subject moved while they are read; `broken` is of `frames_left_out`."""
    shifts = dict(capture.shifts)
    for camera in capture.cameras:
        found = align_shifts(capture, subject, camera, broken.get(camera, set()))
        shifts |= {(subject, camera, light): shift_px for light, shift_px in found.items()}
    return replace(capture, shifts=shifts)


def align_shifts(
    capture: Capture, subject: str, camera: str, broken: set[str]
) -> dict[str, tuple[float, float]]:
    """By light, the camera's pixels down and right that undo the head's motion; none where it is small."""
    frames = read_frames(replace(capture, shifts={}), subject, camera, _FINE_PX)[0].less(broken)
    moved_px = np.zeros((len(frames.light_ids), 2))
    for size in (_COARSER, 1):
        view = _coarser(_moved_back(frames, moved_px), size)
        stereo = fit_stereo(view)
        if stereo is None:
            return {}
        moved_px = moved_px + size * measure_motion(view, stereo).moved_px
    undone = -moved_px * frames.scale
    far = np.hypot(*moved_px.T) > _NOISE_PX
    return {
        light: (round(float(down), 3), round(float(right), 3))
        for light, (down, right), is_far in zip(frames.light_ids, undone, far, strict=True)
        if is_far
    }


def _moved_back(frames: CameraFrames, moved_px: np.ndarray) -> CameraFrames:
    pairs = zip(frames.grey, moved_px, strict=True)
    grey = [
        ndimage.shift(picture, -by, order=1, mode="nearest") if by.any() else picture for picture, by in pairs
    ]
    return replace(frames, grey=np.stack(grey) if grey else frames.grey)


def _coarser(frames: CameraFrames, size: int) -> CameraFrames:
    if size == 1 or not len(frames.grey):
        return frames
    grey = F.avg_pool2d(torch.from_numpy(frames.grey)[:, None], size)[:, 0].numpy()
    return replace(frames, grey=grey, scale=frames.scale * size)
