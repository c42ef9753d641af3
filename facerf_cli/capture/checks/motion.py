"""Head motion between frames: its check, and the shifts of `prepare-dataset --align` that undo it.

**Check.** The offset of each frame from its prediction by photometric stereo, which has the same lighting.
Both are registered on the orientation of their gradients alone (G. Tzimiropoulos et al., *Robust FFT-based
scale-invariant image registration with image gradients*, PAMI 2010), so that remaining shading errors count
little.

**Shifts.** First the path of a slowly drifting head is fitted to those offsets, which reach far but are
coarse. Then each frame's own motion is measured against the frames of neighbouring lights. Shifts as small as
those measured on still heads are not applied.

**Path.** An offset is the sum of the head's path, which bends slowly in the order of the lights; the error of
the shading model, which is similar under neighbouring lights; and the frame's own motion. Each is a Gaussian
process (C. Rasmussen, C. Williams, *Gaussian Processes for Machine Learning*, 2006, sections 2.2 and 5.4).
The size of the path maximises the likelihood of the offsets; on a still head it is 0.

**Own motion.** Each pixel is a Gaussian process over the light's direction. Its prediction of a frame from
the others is the same weighted sum of frames at all pixels (there, equation 5.12), with cast shadows and
highlights.
"""

import math
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import replace
from itertools import product

import numpy as np
import torch
import torch.nn.functional as F
from scipy import ndimage
from scipy.linalg import cho_factor, cho_solve

from facerf_cli.capture.capture import Capture
from facerf_cli.capture.checks.frames import CameraFrames, read_frames
from facerf_cli.capture.checks.shading import Stereo, fit_stereo, lit_pixels
from facerf_cli.capture.findings import Finding

# Pixels here are those of the small frames.
_SMOOTH_PX = 1.0
_REACH_PX = 8  # largest offset that is searched
_LEAST_PEAK = 0.5  # of a perfect match: below it, the frame's own shadows dominate
_IN_FRONT = 0.3  # cosine of light and camera axis: other lights leave most of the face dark
_MOVED_PX = 1.0  # synthetic frames without motion are off by 0.2 in the median and by 0.5 at most
_LEAST_GAIN = 0.1  # of a perfect match: least gain of an offset beyond `_MOVED_PX`
_FINE_PX, _COARSER = 192, 2  # longest side of the fine frames; fine pixels per coarse one
_PATH_FRONT, _OWN_FRONT = -0.2, 0.2  # least cosines to the camera's axis; lights behind light only edges
_PATH_ITERATIONS, _OWN_LEVELS = 3, (_COARSER, _COARSER, _COARSER, 1, 1)
_SHRINK = {_COARSER: 0.1, 1: 0.03}  # ridge of `own_motion`, by fine pixels per pixel
_LEAST_OWN_PX = 0.6  # in fine pixels; still synthetic faces give up to 0.55
# Path: the tried standard deviations, in pixels.
_BENDS = (8.0, 20.0, 50.0)  # frames over which a path bends
_PATHS_PX = (0.25, 0.5, 1.0, 2.0, 4.0)  # of a path, down and right each
_NO_PATH = (1.0, 0.0)
_MODEL_ERRORS_PX, _MODEL_WIDTH = (0.3, 0.6), 0.6  # of the shading model; its reach on the unit sphere
_OWN_MOTIONS_PX = (0.15, 0.4, 1.0, 2.0)  # of a frame's own motion
_SURE = 5.0  # least gain in log likelihood of a path; a lower one finds paths in Extended Yale B
_MOST_FRAMES = 300  # by which the sizes are chosen, at a cost of their cube
_PathModel = tuple[tuple[float, float], tuple[float, float]]  # bend and size; errors of shading, own motion
# Prediction of a frame from the frames of neighbouring lights.
_WIDTH = 0.6  # reach of a light's influence on the unit sphere
_NOISE = 0.05
_MEAN = 1e-3  # variance of what all frames share
_REWEIGHTINGS = 4


def check_motion(frames: CameraFrames, stereo: Stereo) -> Iterator[Finding]:
    """Warn once per camera with frames in which the head has moved."""
    moved_px, trusted = measure_motion(frames, stereo)
    far = np.hypot(*moved_px.T)
    moved = far > _MOVED_PX
    if not moved.any():
        return
    worst = int(far.argmax())
    limit_px, worst_px = _MOVED_PX * frames.scale, far[worst] * frames.scale
    words = (
        f"the head moves: of {trusted.sum()} measurable frames, {moved.sum()} or more are off by over "
        f"{limit_px:.1f} pixels ({frames.light_ids[worst]} by {worst_px:.1f}); --align shifts them back"
    )
    yield frames.warning("motion", words, frames=int(moved.sum()), worst_px=round(float(worst_px), 2))


def measure_motion(
    frames: CameraFrames, stereo: Stereo, least_front: float = _IN_FRONT
) -> tuple[np.ndarray, np.ndarray]:
    """Measure frames against predictions, for lights of a cosine to the camera's axis over `least_front`."""
    predicted = np.zeros(frames.grey.shape)
    predicted[:, stereo.lit] = stereo.predicted(frames.directions)
    front = frames.directions[:, 2] > least_front
    return motion_between(frames.grey, predicted, stereo.lit, front)


def motion_between(
    seen: np.ndarray, predicted: np.ndarray, mask: np.ndarray, judged: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Measure frames [L, h, w] against predictions within `mask` [h, w], for the `judged` [L] ones.

    Returns the offsets [L, 2], down and right, in pixels, and whether they can be trusted [L]; others are 0.
    """
    moved, peaks, gain = np.zeros((len(judged), 2)), np.zeros(len(judged)), np.zeros(len(judged))
    for row in np.flatnonzero(judged):
        pair = (orientation(image) * mask for image in (seen[row], predicted[row]))
        moved[row], peaks[row], gain[row] = register(*pair)
    moved[(gain < _LEAST_GAIN) & (np.hypot(*moved.T) > _MOVED_PX)] = 0
    trusted = judged & (peaks > _LEAST_PEAK)
    return np.where(trusted[:, None], moved, 0), trusted


def orientation(image: np.ndarray) -> np.ndarray:
    """Gradients [h, w] as complex numbers, of length about 1 where strong, shorter in noise."""
    image = image.astype(float)
    right = ndimage.gaussian_filter(image, _SMOOTH_PX, order=(0, 1))
    down = ndimage.gaussian_filter(image, _SMOOTH_PX, order=(1, 0))
    length = np.hypot(right, down)
    return (right + 1j * down) / (length + np.percentile(length, 60) + 1e-12)


def register(moved: np.ndarray, still: np.ndarray) -> tuple[np.ndarray, float, float]:
    """Register one orientation field [h, w] with another by their correlation.

    Returns the offset [2] (down, right), the match there in 0..1, and its gain over the match without offset.
    """
    height, width = moved.shape
    window = np.outer(np.hanning(height), np.hanning(width))
    a, b = moved * window, still * window
    size = (2 * height, 2 * width)  # avoids wrap-around
    correlation = np.fft.ifft2(np.fft.fft2(a, size) * np.conj(np.fft.fft2(b, size))).real
    reach = min(_REACH_PX, height - 2, width - 2)
    near = np.roll(correlation, (reach, reach), (0, 1))[: 2 * reach + 1, : 2 * reach + 1]
    norm = np.sqrt((np.abs(a) ** 2).sum() * (np.abs(b) ** 2).sum()) + 1e-12
    row, column = (int(index) for index in np.unravel_index(near.argmax(), near.shape))
    shift = np.array([peak(near[:, column], row), peak(near[row], column)]) - reach
    return shift, float(near[row, column] / norm), float((near[row, column] - near[reach, reach]) / norm)


def peak(values: np.ndarray, place: int) -> float:
    """Refine the place of a maximum of values [N] by a parabola through its neighbours; an end stays."""
    if not 0 < place < len(values) - 1:
        return float(place)
    before, here, after = values[place - 1 : place + 2].tolist()
    bend = before - 2 * here + after
    return place + (before - after) / (2 * bend) if bend else float(place)


def with_alignment(capture: Capture, subject: str, broken: Mapping[str, set[str]]) -> Capture:
    """Add the shifts of a subject's frames to a capture; `broken` is that of `frames_left_out`."""
    shifts = {
        (subject, camera, light): shift_px
        for camera in capture.cameras
        for light, shift_px in align_shifts(capture, subject, camera, broken.get(camera, set())).items()
    }
    return replace(capture, shifts={**capture.shifts, **shifts})


def align_shifts(
    capture: Capture, subject: str, camera: str, broken: set[str]
) -> dict[str, tuple[float, float]]:
    """Nonzero shifts by light, in the camera's pixels down and right, that undo the head's motion."""
    frames = read_frames(replace(capture, shifts={}), subject, camera, _FINE_PX)[0].without(broken)
    undone = -head_motion(frames) * frames.scale
    return {
        light: (round(float(down), 3), round(float(right), 3))
        for light, (down, right) in zip(frames.light_ids, undone, strict=True)
        if down or right
    }


def head_motion(frames: CameraFrames) -> np.ndarray:
    """Motion [L, 2] of the head in each frame, in pixels of the frames down and right."""
    path = _fit_path(frames)
    judged = frames.directions[:, 2] > _OWN_FRONT
    if not judged.any() or fit_stereo(frames) is None:
        return path
    own, weights = np.zeros(path.shape), weights_of_others(frames.directions)
    for size in _OWN_LEVELS:
        grey = _coarser(_moved_back(frames, path + own), size).grey
        predicted = np.tensordot(weights.astype(np.float32), grey, 1)
        moved_px, trusted = motion_between(grey, predicted, lit_pixels(grey), judged)
        more = own_motion(weights, moved_px, trusted, _SHRINK[size])
        own += size * np.where(judged[:, None], more, 0)
        own[judged] -= np.median(own[judged], axis=0)  # a common offset is not motion between frames
    return path + np.where((np.hypot(*own.T) > _LEAST_OWN_PX)[:, None], own, 0)


def _fit_path(frames: CameraFrames) -> np.ndarray:
    path = np.zeros((len(frames.light_ids), 2))
    for _ in range(_PATH_ITERATIONS):
        view = _coarser(_moved_back(frames, path), _COARSER)
        stereo = fit_stereo(view)
        if stereo is None:
            return path
        moved_px, trusted = measure_motion(view, stereo, _PATH_FRONT)
        path = head_path(path + _COARSER * moved_px, trusted, frames.directions)
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


def head_path(moved_px: np.ndarray, trusted: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """Fit the head's path [L, 2] at all frames to the offsets [L, 2] of the `trusted` [L] ones."""
    rows = np.flatnonzero(trusted)
    if not len(rows):
        return np.zeros(moved_px.shape)
    few = rows[:: max(math.ceil(len(rows) / _MOST_FRAMES), 1)]
    near = _model_correlation(directions[few])

    def likeliest(paths: Iterable[tuple[float, float]]) -> tuple[float, _PathModel]:
        tries = list(product(paths, product(_MODEL_ERRORS_PX, _OWN_MOTIONS_PX)))
        found = [_log_likelihood(_covariance(model, few, near), moved_px[few]) for model in tries]
        return max(found), tries[int(np.argmax(found))]

    still, _ = likeliest([_NO_PATH])
    best, model = likeliest(product(_BENDS, _PATHS_PX))
    if best <= still + _SURE:
        return np.zeros(moved_px.shape)
    covariance = _covariance(model, rows, _model_correlation(directions[rows]))
    shared = _path_covariance(model[0], np.arange(len(trusted))[:, None] - rows)
    return shared @ cho_solve(cho_factor(covariance), moved_px[rows])


def _path_covariance(path: tuple[float, float], apart: np.ndarray) -> np.ndarray:
    """Covariance of a path, (frames over which it bends, size), at frames `apart` in the order of lights."""
    bend, size_px = path
    return size_px**2 * np.exp(-(apart**2) / (2 * bend**2))


def _covariance(model: _PathModel, rows: np.ndarray, near: np.ndarray) -> np.ndarray:
    """Covariance [N, N] of the offsets of frames [N]; `near` [N, N] correlates the shading's errors."""
    path, (shading_px, own_px) = model
    shared = _path_covariance(path, rows[:, None] - rows)
    return shared + shading_px**2 * near + own_px**2 * np.eye(len(rows))


def _model_correlation(directions: np.ndarray) -> np.ndarray:
    """Correlation [N, N] of the shading model's errors under lights from directions [N, 3]."""
    return np.exp((directions @ directions.T - 1) / _MODEL_WIDTH**2)


def _log_likelihood(covariance: np.ndarray, seen: np.ndarray) -> float:
    """Log likelihood of two columns of offsets [N, 2], up to a constant."""
    factor = cho_factor(covariance)
    log_volume = 2 * np.log(np.diag(factor[0])).sum()
    return float(-0.5 * (seen * cho_solve(factor, seen)).sum() - log_volume)


def weights_of_others(directions: np.ndarray) -> np.ndarray:
    """Weights [L, L], diagonal 0, that predict each frame from the others by light directions [L, 3]."""
    kernel = np.exp((directions @ directions.T - 1) / _WIDTH**2) + _MEAN
    inverse = np.linalg.inv(kernel + _NOISE * np.eye(len(directions)))
    return np.eye(len(directions)) - inverse / np.diag(inverse)[:, None]


def own_motion(weights: np.ndarray, moved_px: np.ndarray, trusted: np.ndarray, shrink: float) -> np.ndarray:
    """Solve for the motion [L, 2] of each frame from the offsets [L, 2] between frames and predictions.

    A prediction moves with the frames that it is made of. Motion that all frames of a region share looks like
    the change of shading with the light; the ridge `shrink` leaves it out. Outliers get a low weight.
    """
    differences = np.eye(len(weights)) - weights
    ridge, count = shrink * np.eye(len(weights)), trusted.astype(float)
    for _ in range(_REWEIGHTINGS):
        weighted = differences.T * count
        found = np.linalg.solve(weighted @ differences + ridge, weighted @ moved_px)
        residual = np.hypot(*(moved_px - differences @ found).T)
        spread = 1.48 * np.median(residual[trusted]) + 0.02 if trusted.any() else 1.0
        count = trusted / (1 + (residual / (2 * spread)) ** 2)
    return found
