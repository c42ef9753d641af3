"""Head motion between frames: how far each frame lies from where the others say that it should.

A frame is registered with its prediction by photometric stereo, which is lit the same, on the orientation of
gradients alone (G. Tzimiropoulos et al., *Robust FFT-based scale-invariant image registration with image
gradients*, PAMI 2010), so that what is left of shading errors counts little.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from facerf_cli.stage.checks.findings import Finding
from facerf_cli.stage.checks.frames import CameraFrames
from facerf_cli.stage.checks.parabola import vertex
from facerf_cli.stage.checks.stereo import Stereo

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
        pair = (orientation(picture) * where for picture in (seen[row], predicted[row]))
        moved[row], peaks[row], gain[row] = register(*pair)
    moved[(gain < _LEAST_GAIN) & (np.hypot(*moved.T) > _MOVED_PX)] = 0
    trusted = asked & (peaks > _LEAST_PEAK)
    return Motion(np.where(trusted[:, None], moved, 0), trusted)


def orientation(picture: np.ndarray) -> np.ndarray:
    """Gradients as complex numbers [h, w] of length 1 where they are strong, less where noise makes them."""
    picture = picture.astype(float)
    right = ndimage.gaussian_filter(picture, _SMOOTH_PX, order=(0, 1))
    down = ndimage.gaussian_filter(picture, _SMOOTH_PX, order=(1, 0))
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
