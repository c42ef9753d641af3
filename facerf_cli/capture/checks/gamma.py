"""Check for a display curve in frames that are declared linear.

Two methods find the exponent e for which values^e are linear. With a frame under all lights at once, the
other frames must add up to it; this needs no model of the object, but few stages record that frame. Otherwise
shading decides: photometric stereo is fitted to values^e, raised to 1/e and compared with the values. That
comparison uses the same values for every e; on values^e a low exponent would win by flattening everything.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from facerf_cli.capture.capture import Capture
from facerf_cli.capture.checks.findings import Finding
from facerf_cli.capture.checks.frames import CameraFrames, grey_of, small
from facerf_cli.capture.checks.numerics import parabola_vertex
from facerf_cli.capture.pattern import FULL_NAMES
from facerf_cli.errors import InputError
from facerf_cli.files.images import read_image

EXPONENTS = np.array([0.35, 0.4, 0.45, 0.55, 0.7, 0.85, 1.0, 1.2, 1.45, 1.8, 2.2, 2.6, 3.0])
# Linear frames of Extended Yale B's subjects 05, 15 and 22 give 0.85 to 1, synthetic ones 1; encoded by 1/2.2
# they give 1.7 to 2.4.
_LINEAR = (0.6, 1.5)
_EXACTLY_LINEAR = (0.93, 1.07)  # by a frame under all lights
_CLEAR = 1.25  # least ratio of the error at exponent 1 to the smallest error
# By shading.
_PIXELS, _ITERATIONS = 600, 6
_LEAST_FRAMES = 8
_FACING = 0.3  # cosine of light and normal
_LIT = 0.25  # of a pixel's brightest frame, values as they are
# By additivity.
_FINE_EXPONENTS = np.geomspace(EXPONENTS[0], EXPONENTS[-1], 80)  # its minimum is sharp
_NOISE = 1e-3  # least log ratio that a sum can reach
_DARK_PIXEL = 0.02  # of the brightest: darker pixels are noise


@dataclass(frozen=True)
class Curve:
    """The exponent that linearises a camera's frames best."""

    exponent: float
    times_worse: float  # error at exponent 1 over the smallest error
    exact: bool = False  # found by additivity, not by shading


def check_gamma(subject: str, curves: Sequence[Curve]) -> Iterator[Finding]:
    """Report one error for a subject whose cameras agree, in the median, that values are not linear."""
    if not curves:
        return
    exponent = float(np.median([curve.exponent for curve in curves]))
    worse = float(np.median([curve.times_worse for curve in curves]))
    least, most = _EXACTLY_LINEAR if all(curve.exact for curve in curves) else _LINEAR
    if least < exponent < most or worse < _CLEAR:
        return
    words = (
        f"frames are declared linear, but values to the power {exponent:.1f} explain them {worse:.1f} "
        "times better; give their colour space"
    )
    figures = {"exponent": round(exponent, 2), "times_better": round(worse, 2), "cameras": len(curves)}
    yield Finding("error", "gamma", subject, words, figures=figures)


def fit_exponent(frames: CameraFrames, lit: np.ndarray) -> Curve | None:
    """Fit the exponent to a camera's lit pixels [h, w] by shading; None where too little is lit."""
    values = np.maximum(frames.grey[:, lit].astype(float), 0)
    step = max(values.shape[1] // _PIXELS, 1)
    values = values[:, ::step]
    top = np.percentile(values, 98, axis=0)
    values = values[:, top > 0] / top[top > 0]
    used = values > _LIT
    if len(values) < _LEAST_FRAMES or used.sum() < _PIXELS:
        return None
    errors = np.array([_shading_error(values, used, frames.directions, exponent) for exponent in EXPONENTS])
    place = int(errors.argmin())
    exponent = parabola_vertex(np.log(EXPONENTS), errors, place)
    at_one = float(errors[np.argmin(np.abs(EXPONENTS - 1))])
    return Curve(float(np.exp(exponent)), at_one / max(float(errors[place]), 1e-9))


def _shading_error(values: np.ndarray, used: np.ndarray, directions: np.ndarray, exponent: float) -> float:
    """Median error of matte shading on values [L, P] that are scaled to 1."""
    linear = values**exponent
    outer = (directions[:, :, None] * directions[:, None]).reshape(len(directions), -1)
    weights = used.astype(float)
    for _ in range(_ITERATIONS):
        matrices = (weights.T @ outer).reshape(-1, 3, 3) + 1e-3 * np.eye(3)
        g = np.linalg.solve(matrices, ((weights * linear).T @ directions)[..., None])[..., 0]
        shaded = directions @ g.T
        residual = np.abs(linear - shaded)
        spread = 1.48 * np.median(residual, axis=0) + 1e-3
        weights = (shaded > _FACING * np.linalg.norm(g, axis=1)) / (1 + (residual / (2 * spread)) ** 2)
    back = np.maximum(shaded, 0) ** (1 / exponent)
    return float(np.median(np.abs(values - back)[used]))


def added_exponent(capture: Capture, frames: CameraFrames) -> Curve | None:
    """Fit the exponent for which all frames add up to the frame under all lights; None without that frame.

    None also where a light's frame is missing, which would look like a curve.
    """
    full = _full_frame(capture, frames)
    if full is None or len(frames.light_ids) < len(capture.light_ids):
        return None
    strength = capture.intensities[frames.places].mean(1)[:, None]
    lit = full > _DARK_PIXEL * full.max()
    each = np.maximum(frames.grey[:, lit] * strength, 0).astype(float)
    together = full[lit].astype(float)
    errors = np.array([_sum_error(each, together, exponent) for exponent in _FINE_EXPONENTS])
    at_one = _sum_error(each, together, 1.0)
    exponent = float(_FINE_EXPONENTS[errors.argmin()])
    return Curve(exponent, at_one / max(float(errors.min()), _NOISE), exact=True)


def _sum_error(each: np.ndarray, together: np.ndarray, exponent: float) -> float:
    """Median log ratio of the sum of linearised frames [L, P] and the linearised full frame [P]."""
    return float(np.median(np.abs(np.log((each**exponent).sum(0) + 1e-12) - exponent * np.log(together))))


def _full_frame(capture: Capture, frames: CameraFrames) -> np.ndarray | None:
    """Read the grey frame [h, w] under all lights, as recorded less the black level; None without one."""
    for name in FULL_NAMES:
        path = capture.frame_path(frames.subject, frames.camera, name)
        if name in capture.light_ids or not path.is_file():
            continue
        try:
            pixels = read_image(path, capture.colour_space, non_finite="zero").pixels
        except InputError:
            return None
        grey = small(grey_of(pixels) - np.float32(capture.black_level), frames.grey.shape[1:])
        return grey if grey.max() > 0 else None
    return None
