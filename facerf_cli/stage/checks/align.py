"""Head motion undone: the shifts that take each frame back to where the others have the head.

First the path of a head that drifts, against photometric stereo, which tells far but not finely (`path.py`);
then each frame's own motion, against the frames under the lamps around it (`neighbours.py`). A head that is
still is left alone: shifts that are shorter than what is found on one are not made.
"""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import torch
import torch.nn.functional as F
from scipy import ndimage

from facerf_cli.stage.checks.frames import CameraFrames, read_frames
from facerf_cli.stage.checks.motion import measure_motion, motion_between
from facerf_cli.stage.checks.neighbours import own_motion, weights_of_others
from facerf_cli.stage.checks.path import head_path
from facerf_cli.stage.checks.stereo import fit_stereo, lit_pixels
from facerf_cli.stage.data.capture import Capture

_FINE_PX, _COARSER = 192, 2  # the longer side of the fine frames; fine pixels to a coarse one
_PATH_FRONT, _OWN_FRONT = -0.2, 0.2  # cosines to the camera's axis: lamps further behind light rims alone
_SHRINK = {_COARSER: 0.1, 1: 0.03}  # by pixels: what the lamps of a region share, see `own_motion`
_PATH_ROUNDS, _OWN_ROUNDS = 3, (_COARSER, _COARSER, _COARSER, 1, 1)
_OWN_PX = 0.6  # of a fine pixel: on still synthetic faces up to 0.55 is found


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
    undone = -head_motion(frames) * frames.scale
    return {
        light: (round(float(down), 3), round(float(right), 3))
        for light, (down, right) in zip(frames.light_ids, undone, strict=True)
        if down or right
    }


def head_motion(frames: CameraFrames) -> np.ndarray:
    """How far the head has moved in each frame [L, 2], pixels of the frames down and right."""
    path = _path(frames)
    asked = frames.directions[:, 2] > _OWN_FRONT
    if not asked.any() or fit_stereo(frames) is None:
        return path
    own, weights = np.zeros(path.shape), weights_of_others(frames.directions)
    for size in _OWN_ROUNDS:
        grey = _coarser(_moved_back(frames, path + own), size).grey
        predicted = np.tensordot(weights.astype(np.float32), grey, 1)
        found = motion_between(grey, predicted, lit_pixels(grey), asked)
        more = own_motion(weights, found.moved_px, found.trusted, _SHRINK[size])
        own += size * np.where(asked[:, None], more, 0)
        own[asked] -= np.median(own[asked], axis=0)  # the others' motion is nobody's
    return path + np.where((np.hypot(*own.T) > _OWN_PX)[:, None], own, 0)


def _path(frames: CameraFrames) -> np.ndarray:
    path = np.zeros((len(frames.light_ids), 2))
    for _ in range(_PATH_ROUNDS):
        view = _coarser(_moved_back(frames, path), _COARSER)
        stereo = fit_stereo(view)
        if stereo is None:
            return path
        found = measure_motion(view, stereo, _PATH_FRONT)
        path = head_path(path + _COARSER * found.moved_px, found.trusted, frames.directions)
        if not path.any():
            return path
    return path


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
