"""Check of head motion between frames.

Each frame is registered with its prediction by photometric stereo, which has the same lighting. Only the
orientation of their gradients counts (G. Tzimiropoulos et al., *Robust FFT-based scale-invariant image
registration with image gradients*, PAMI 2010), so that remaining shading errors have little influence.
"""

from collections.abc import Iterator

import numpy as np
from scipy import ndimage

from facerf_cli.capture.checks.frames import CameraFrames
from facerf_cli.capture.checks.shading import Stereo
from facerf_cli.capture.findings import Finding

# Pixels of the small frames.
_SMOOTH_PX = 1.0
_REACH_PX = 8  # largest offset that is searched
_LEAST_PEAK = 0.5  # of a perfect match; below it, the frame's own shadows dominate
_IN_FRONT = 0.3  # cosine of light and camera axis: other lights leave most of the face dark
_MOVED_PX = 1.0  # synthetic frames without motion are off by 0.2 in the median and by 0.5 at most
_LEAST_GAIN = 0.1  # of a perfect match: least gain of an offset beyond `_MOVED_PX`


def check_motion(frames: CameraFrames, stereo: Stereo) -> Iterator[Finding]:
    """Warn once per camera if the head has moved between frames."""
    moved_px, trusted = measure_motion(frames, stereo)
    far = np.hypot(*moved_px.T)
    moved = far > _MOVED_PX
    if not moved.any():
        return
    worst = int(far.argmax())
    limit_px, worst_px = _MOVED_PX * frames.scale, far[worst] * frames.scale
    words = (
        f"the head moves: of {trusted.sum()} measurable frames, {moved.sum()} or more are off by over "
        f"{limit_px:.1f} pixels ({frames.light_ids[worst]} by {worst_px:.1f}); align "
        "the frames by optical flow, or take them again"
    )
    yield frames.warning("motion", words, frames=int(moved.sum()), worst_px=round(float(worst_px), 2))


def measure_motion(frames: CameraFrames, stereo: Stereo) -> tuple[np.ndarray, np.ndarray]:
    """Register the frames of lights in front with their predictions.

    Returns the offsets [L, 2], down and right, in pixels, and which are reliable [L]; the others are 0.
    """
    predicted = np.zeros(frames.grey.shape)
    predicted[:, stereo.lit] = stereo.predicted(frames.directions)
    judged = frames.directions[:, 2] > _IN_FRONT
    moved, peaks, gain = np.zeros((len(judged), 2)), np.zeros(len(judged)), np.zeros(len(judged))
    for row in np.flatnonzero(judged):
        pair = (orientation(image) * stereo.lit for image in (frames.grey[row], predicted[row]))
        moved[row], peaks[row], gain[row] = register(*pair)
    moved[(gain < _LEAST_GAIN) & (np.hypot(*moved.T) > _MOVED_PX)] = 0
    trusted = judged & (peaks > _LEAST_PEAK)
    return np.where(trusted[:, None], moved, 0), trusted


def orientation(image: np.ndarray) -> np.ndarray:
    """Return gradients [h, w] as complex numbers; their length is about 1, and less in noise."""
    image = image.astype(float)
    right = ndimage.gaussian_filter(image, _SMOOTH_PX, order=(0, 1))
    down = ndimage.gaussian_filter(image, _SMOOTH_PX, order=(1, 0))
    length = np.hypot(right, down)
    return (right + 1j * down) / (length + np.percentile(length, 60) + 1e-12)


def register(moved: np.ndarray, still: np.ndarray) -> tuple[np.ndarray, float, float]:
    """Register an orientation field [h, w] with another by their correlation.

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
    """Refine the index of a maximum of values [N] by a parabola, except at the ends."""
    if not 0 < place < len(values) - 1:
        return float(place)
    before, here, after = values[place - 1 : place + 2].tolist()
    bend = before - 2 * here + after
    return place + (before - after) / (2 * bend) if bend else float(place)
