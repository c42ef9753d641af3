"""Head motion between frames: how far each frame lies from where the others say that it should.

A frame is registered with its prediction by photometric stereo, which is lit the same, on the orientation of
gradients alone (G. Tzimiropoulos et al., *Robust FFT-based scale-invariant image registration with image
gradients*, PAMI 2010), so that what is left of shading errors counts little.

Each frame as the frames under the lamps around it have it, cast shadows and highlights included.

Every pixel is a Gaussian process over the lamp's direction (C. Rasmussen, C. Williams, *Gaussian Processes
for Machine Learning*, 2006), and what it predicts of a frame that it did not see is the same weighted sum of
the others at all pixels (there, equation 5.12).

The path of a head that drifts while frames are taken one after the other, told from errors of shading.

How far a frame lies from what photometric stereo predicts is the head's path, which bends slowly in the
order of the lights; an error of the shading model, much the same under neighbouring lamps; and each frame's
own. All three are Gaussian processes (Rasmussen and Williams 2006, 2.2 and 5.4). How far the head goes is
the value under which the measurements are likeliest: on a still head that is nowhere.

Head motion undone: the shifts that take each frame back to where the others have the head.

First the path of a head that drifts, against photometric stereo, which tells far but not finely (`path.py`);
then each frame's own motion, against the frames under the lamps around it (`neighbours.py`). A head that is
still is left alone: shifts that are shorter than what is found on one are not made.
"""

import math
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from itertools import product

import numpy as np
import torch
import torch.nn.functional as F
from scipy import ndimage
from scipy.linalg import cho_factor, cho_solve

from facerf_cli.capture.capture import Capture
from facerf_cli.capture.checks.findings import Finding
from facerf_cli.capture.checks.frames import CameraFrames, Stereo, fit_stereo, lit_pixels, read_frames
from facerf_cli.capture.checks.shading import vertex

_SMOOTH_PX = 1.0
_REACH_PX = 8  # how far is searched, in small pixels
_LEAST_PEAK = 0.5  # of a perfect match: below it the frame's own shadows decide
_IN_FRONT = 0.3  # cosine of lamp and camera axis: others leave most of the face dark
# Without motion, synthetic frames are found moved by 0.2 small pixels in the median and 0.5 at most.
_MOVED_PX = 1.0
_LEAST_GAIN = 0.1  # of a perfect match: what a shift that far must win


@dataclass(frozen=True, eq=False)
class Motion:
    """How frames have moved [L, 2], small pixels down and right, and which of these are trusted [L]."""

    moved_px: np.ndarray
    trusted: np.ndarray


def measure_motion(frames: CameraFrames, stereo: Stereo, least_front: float = _IN_FRONT) -> Motion:
    """Each frame against its prediction; frames that cannot be trusted have 0.

    `least_front`: the cosine of lamp and camera axis that frames must have.
    """
    predicted = np.zeros(frames.grey.shape)
    predicted[:, stereo.lit] = stereo.predicted(frames.directions)
    front = frames.directions[:, 2] > least_front
    return motion_between(frames.grey, predicted, stereo.lit, front)


def motion_between(seen: np.ndarray, predicted: np.ndarray, where: np.ndarray, asked: np.ndarray) -> Motion:
    """Frames [L, h, w] against predictions, over `where` [h, w]; those that are not `asked` [L] have 0."""
    moved, peaks, gain = np.zeros((len(asked), 2)), np.zeros(len(asked)), np.zeros(len(asked))
    for row in np.flatnonzero(asked):
        pair = (orientation(image) * where for image in (seen[row], predicted[row]))
        moved[row], peaks[row], gain[row] = register(*pair)
    moved[(gain < _LEAST_GAIN) & (np.hypot(*moved.T) > _MOVED_PX)] = 0
    trusted = asked & (peaks > _LEAST_PEAK)
    return Motion(np.where(trusted[:, None], moved, 0), trusted)


def orientation(image: np.ndarray) -> np.ndarray:
    """Gradients as complex numbers [h, w] of length 1 where they are strong, less where noise makes them."""
    image = image.astype(float)
    right = ndimage.gaussian_filter(image, _SMOOTH_PX, order=(0, 1))
    down = ndimage.gaussian_filter(image, _SMOOTH_PX, order=(1, 0))
    length = np.hypot(right, down)
    return (right + 1j * down) / (length + np.percentile(length, 60) + 1e-12)


def register(moved: np.ndarray, still: np.ndarray) -> tuple[np.ndarray, float, float]:
    """How far one orientation field lies from another [2] (down, right); how well they match then, in 0..1.

    The last figure is how much better that is than without a shift.
    """
    height, width = moved.shape
    window = np.outer(np.hanning(height), np.hanning(width))
    a, b = moved * window, still * window
    size = (2 * height, 2 * width)  # so that nothing wraps around
    correlation = np.fft.ifft2(np.fft.fft2(a, size) * np.conj(np.fft.fft2(b, size))).real
    reach = min(_REACH_PX, height - 2, width - 2)
    near = np.roll(correlation, (reach, reach), (0, 1))[: 2 * reach + 1, : 2 * reach + 1]
    norm = np.sqrt((np.abs(a) ** 2).sum() * (np.abs(b) ** 2).sum()) + 1e-12
    row, column = (int(index) for index in np.unravel_index(near.argmax(), near.shape))
    px = np.arange(-reach, reach + 1.0)
    shift = np.array([vertex(px, near[:, column], row), vertex(px, near[row], column)])
    return shift, float(near[row, column] / norm), float((near[row, column] - near[reach, reach]) / norm)


def check_motion(frames: CameraFrames, stereo: Stereo) -> Iterator[Finding]:
    """One warning a camera where frames have moved."""
    motion = measure_motion(frames, stereo)
    far = np.hypot(*motion.moved_px.T)
    moved = far > _MOVED_PX
    if not moved.any():
        return
    worst = int(far.argmax())
    limit_px, worst_px = _MOVED_PX * frames.scale, far[worst] * frames.scale
    words = (
        f"the head moves: of {motion.trusted.sum()} frames that tell {moved.sum()} or more are off by over "
        f"{limit_px:.1f} pixels ({frames.light_ids[worst]} by {worst_px:.1f}); --align shifts them back"
    )
    figures = {"frames": int(moved.sum()), "worst_px": round(float(worst_px), 2)}
    yield Finding("warning", "motion", frames.subject, words, frames.camera, figures=figures)


_WIDTH = 0.6  # of the unit sphere: how far from a lamp another one still tells of it
_NOISE = 0.05
_MEAN = 1e-3  # variance of what all frames share
_ROUNDS = 4


def weights_of_others(directions: np.ndarray) -> np.ndarray:
    """What each frame is of the others [L, L], its diagonal 0, by the lamps' directions [L, 3]."""
    kernel = np.exp((directions @ directions.T - 1) / _WIDTH**2) + _MEAN
    inverse = np.linalg.inv(kernel + _NOISE * np.eye(len(directions)))
    return np.eye(len(directions)) - inverse / np.diag(inverse)[:, None]


def own_motion(weights: np.ndarray, moved_px: np.ndarray, trusted: np.ndarray, shrink: float) -> np.ndarray:
    """Motion [L, 2] of each frame that explains how far each lies from its prediction [L, 2].

    A prediction moves with the frames that it is made of. What all frames of a region share cannot be told
    from how shading moves with the lamp, and `shrink` leaves it out. Frames that disagree count less.
    """
    differences = np.eye(len(weights)) - weights
    ridge, count = shrink * np.eye(len(weights)), trusted.astype(float)
    for _ in range(_ROUNDS):
        weighed = differences.T * count
        found = np.linalg.solve(weighed @ differences + ridge, weighed @ moved_px)
        residual = np.hypot(*(moved_px - differences @ found).T)
        spread = 1.48 * np.median(residual[trusted]) + 0.02 if trusted.any() else 1.0
        count = trusted / (1 + (residual / (2 * spread)) ** 2)
    return found


_TIMES = (8.0, 20.0, 50.0)  # frames over which a path bends
_REACHES_PX = (0.25, 0.5, 1.0, 2.0, 4.0)  # standard deviation of a path, down and right each
_STILL = (1.0, 0.0)  # no path
_MODELS_PX, _MODEL_WIDTH = (0.3, 0.6), 0.6  # and of the shading model's error
_OWN_MOTIONS_PX = (0.15, 0.4, 1.0, 2.0)  # and of what each frame has beside
_SURE = 5.0  # natural log by which a path must be likelier than none; less sees paths in Extended Yale B
_MOST = 300  # frames by which sizes are chosen; it costs their cube


@dataclass(frozen=True)
class _Sizes:
    """What measurements are made of, in pixels, and over how many frames the path bends."""

    frames: float
    reach_px: float
    model_px: float
    own_px: float

    def bends(self, apart: np.ndarray) -> np.ndarray:
        """What the path has in common at frames that lie so many apart."""
        return self.reach_px**2 * np.exp(-(apart**2) / (2 * self.frames**2))

    def covariance(self, rows: np.ndarray, near: np.ndarray) -> np.ndarray:
        """Of the measurements of frames [N], whose lamps are `near` each other [N, N]."""
        bends = self.bends(rows[:, None] - rows)
        return bends + self.model_px**2 * near + self.own_px**2 * np.eye(len(rows))


def head_path(moved_px: np.ndarray, trusted: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """The path [L, 2] at all frames, by measurements [L, 2] of those that are `trusted` [L]."""
    rows = np.flatnonzero(trusted)
    if not len(rows):
        return np.zeros(moved_px.shape)
    few = rows[:: max(math.ceil(len(rows) / _MOST), 1)]
    near = _near(directions[few])

    def likeliest(paths: Iterable[tuple[float, float]]) -> tuple[float, _Sizes]:
        tries = [_Sizes(*path, *errors) for path in paths for errors in product(_MODELS_PX, _OWN_MOTIONS_PX)]
        found = [_log_likelihood(sizes.covariance(few, near), moved_px[few]) for sizes in tries]
        return max(found), tries[int(np.argmax(found))]

    still, _ = likeliest([_STILL])
    best, sizes = likeliest(product(_TIMES, _REACHES_PX))
    if best <= still + _SURE:
        return np.zeros(moved_px.shape)
    covariance = sizes.covariance(rows, _near(directions[rows]))
    bends = sizes.bends(np.arange(len(trusted))[:, None] - rows)
    return bends @ cho_solve(cho_factor(covariance), moved_px[rows])


def _near(directions: np.ndarray) -> np.ndarray:
    """How much of the model's error lamps [N, 3] have in common [N, N]."""
    return np.exp((directions @ directions.T - 1) / _MODEL_WIDTH**2)


def _log_likelihood(covariance: np.ndarray, seen: np.ndarray) -> float:
    """Of two columns of measurements [N, 2], but for a constant."""
    factor = cho_factor(covariance)
    log_volume = 2 * np.log(np.diag(factor[0])).sum()
    return float(-0.5 * (seen * cho_solve(factor, seen)).sum() - log_volume)


_FINE_PX, _COARSER = 192, 2  # the longer side of the fine frames; fine pixels to a coarse one
_PATH_FRONT, _OWN_FRONT = -0.2, 0.2  # cosines to the camera's axis: lamps further behind light rims alone
_SHRINK = {_COARSER: 0.1, 1: 0.03}  # by pixels: what the lamps of a region share, see `own_motion`
_PATH_ROUNDS, _OWN_ROUNDS = 3, (_COARSER, _COARSER, _COARSER, 1, 1)
_OWN_JUMP_PX = 0.6  # of a fine pixel: on still synthetic faces up to 0.55 is found


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
    return path + np.where((np.hypot(*own.T) > _OWN_JUMP_PX)[:, None], own, 0)


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
    grey = [ndimage.shift(image, -by, order=1, mode="nearest") if by.any() else image for image, by in pairs]
    return replace(frames, grey=np.stack(grey) if grey else frames.grey)


def _coarser(frames: CameraFrames, size: int) -> CameraFrames:
    if size == 1 or not len(frames.grey):
        return frames
    grey = F.avg_pool2d(torch.from_numpy(frames.grey)[:, None], size)[:, 0].numpy()
    return replace(frames, grey=grey, scale=frames.scale * size)
