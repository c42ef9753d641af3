"""Head motion between frames: the offset of each frame from its prediction by photometric stereo.

A prediction has the same lighting as its frame. Both are registered on the orientation of their gradients
alone (G. Tzimiropoulos et al., *Robust FFT-based scale-invariant image registration with image gradients*,
PAMI 2010), so that remaining shading errors count little.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from facerf_cli.capture.checks.findings import Finding
from facerf_cli.capture.checks.frames import CameraFrames
from facerf_cli.capture.checks.numerics import parabola_vertex
from facerf_cli.capture.checks.stereo import Stereo

# Pixels here are those of the small frames.
_SMOOTH_PX = 1.0
_REACH_PX = 8  # largest offset that is searched
_LEAST_PEAK = 0.5  # of a perfect match: below it, the frame's own shadows dominate
_IN_FRONT = 0.3  # cosine of light and camera axis: other lights leave most of the face dark
_MOVED_PX = 1.0  # synthetic frames without motion are off by 0.2 in the median and by 0.5 at most
_LEAST_GAIN = 0.1  # of a perfect match: least gain of an offset beyond `_MOVED_PX`


@dataclass(frozen=True, eq=False)
class Motion:
    """Offsets of frames from their predictions."""

    moved_px: np.ndarray  # [L, 2] down and right, in pixels of the small frames
    trusted: np.ndarray  # [L] bool; offsets of other frames are 0


def check_motion(frames: CameraFrames, stereo: Stereo) -> Iterator[Finding]:
    """Warn once per camera with frames in which the head has moved."""
    motion = measure_motion(frames, stereo)
    far = np.hypot(*motion.moved_px.T)
    moved = far > _MOVED_PX
    if not moved.any():
        return
    worst = int(far.argmax())
    limit_px, worst_px = _MOVED_PX * frames.scale, far[worst] * frames.scale
    words = (
        f"the head moves: of {motion.trusted.sum()} measurable frames, {moved.sum()} or more are off by over "
        f"{limit_px:.1f} pixels ({frames.light_ids[worst]} by {worst_px:.1f}); --align shifts them back"
    )
    figures = {"frames": int(moved.sum()), "worst_px": round(float(worst_px), 2)}
    yield Finding("warning", "motion", frames.subject, words, frames.camera, figures=figures)


def measure_motion(frames: CameraFrames, stereo: Stereo, least_front: float = _IN_FRONT) -> Motion:
    """Measure frames against predictions, for lights of a cosine to the camera's axis over `least_front`."""
    predicted = np.zeros(frames.grey.shape)
    predicted[:, stereo.lit] = stereo.predicted(frames.directions)
    front = frames.directions[:, 2] > least_front
    return motion_between(frames.grey, predicted, stereo.lit, front)


def motion_between(seen: np.ndarray, predicted: np.ndarray, mask: np.ndarray, judged: np.ndarray) -> Motion:
    """Measure frames [L, h, w] against predictions within `mask` [h, w], for the `judged` [L] ones."""
    moved, peaks, gain = np.zeros((len(judged), 2)), np.zeros(len(judged)), np.zeros(len(judged))
    for row in np.flatnonzero(judged):
        pair = (orientation(image) * mask for image in (seen[row], predicted[row]))
        moved[row], peaks[row], gain[row] = register(*pair)
    moved[(gain < _LEAST_GAIN) & (np.hypot(*moved.T) > _MOVED_PX)] = 0
    trusted = judged & (peaks > _LEAST_PEAK)
    return Motion(np.where(trusted[:, None], moved, 0), trusted)


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
    px = np.arange(-reach, reach + 1.0)
    shift = np.array([parabola_vertex(px, near[:, column], row), parabola_vertex(px, near[row], column)])
    return shift, float(near[row, column] / norm), float((near[row, column] - near[reach, reach]) / norm)
