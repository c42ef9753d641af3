"""A display curve in frames that are declared linear: which exponent makes them matt under point lamps.

Frames were photometric stereo's, g . d, and were then raised to some power: at every exponent e, values^e are
fitted, the fit is taken back by 1/e and compared with the values. The comparison is always made on the same
values, for on values^e a low exponent wins by flattening everything.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from facerf_cli.stage.checks.findings import Finding
from facerf_cli.stage.checks.frames import CameraFrames
from facerf_cli.stage.checks.parabola import vertex

EXPONENTS = np.array([0.35, 0.4, 0.45, 0.55, 0.7, 0.85, 1.0, 1.2, 1.45, 1.8, 2.2, 2.6, 3.0])
# Linear frames of Extended Yale B's subjects 05, 15 and 22 come out at 0.85 to 1, synthetic ones at 1;
# encoded by 1/2.2 they come out at 1.7 to 2.4.
_LINEAR = (0.6, 1.5)
_EXACTLY_LINEAR = (0.93, 1.07)  # where a frame of all lamps tells
_CLEAR = 1.25  # how many times worse than the best exponent 1 must be
_PIXELS, _ROUNDS = 600, 6
_FACING = 0.3
_LIT = 0.25  # of a pixel's brightest frame, values as they are


@dataclass(frozen=True)
class Curve:
    """The exponent that decodes the frames best, and how many times worse 1 is.

    `exact`: it was told by additivity, not by shading.
    """

    exponent: float
    times_worse: float
    exact: bool = False


def fit_exponent(frames: CameraFrames, lit: np.ndarray) -> Curve | None:
    """The best exponent over a camera's lit pixels [h, w]; None where too little is lit to tell."""
    values = np.maximum(frames.grey[:, lit].astype(float), 0)
    step = max(values.shape[1] // _PIXELS, 1)
    values = values[:, ::step]
    top = np.percentile(values, 98, axis=0)
    values = values[:, top > 0] / top[top > 0]
    used = values > _LIT
    if len(values) < 8 or used.sum() < _PIXELS:
        return None
    errors = np.array([_error(values, used, frames.directions, exponent) for exponent in EXPONENTS])
    place = int(errors.argmin())
    exponent = vertex(np.log(EXPONENTS), errors, place)
    at_one = float(errors[np.argmin(np.abs(EXPONENTS - 1))])
    return Curve(float(np.exp(exponent)), at_one / max(float(errors[place]), 1e-9))


def _error(values: np.ndarray, used: np.ndarray, directions: np.ndarray, exponent: float) -> float:
    """The median error of matt shading on values [L, P] that are scaled to 1."""
    linear = values**exponent
    outer = (directions[:, :, None] * directions[:, None]).reshape(len(directions), -1)
    weights = used.astype(float)
    for _ in range(_ROUNDS):
        matrices = (weights.T @ outer).reshape(-1, 3, 3) + 1e-3 * np.eye(3)
        g = np.linalg.solve(matrices, ((weights * linear).T @ directions)[..., None])[..., 0]
        shaded = directions @ g.T
        residual = np.abs(linear - shaded)
        spread = 1.48 * np.median(residual, axis=0) + 1e-3
        weights = (shaded > _FACING * np.linalg.norm(g, axis=1)) / (1 + (residual / (2 * spread)) ** 2)
    back = np.maximum(shaded, 0) ** (1 / exponent)
    return float(np.median(np.abs(values - back)[used]))


def check_gamma(subject: str, curves: Sequence[Curve]) -> Iterator[Finding]:
    """One error for the subject where its cameras agree, in the median, that values are not linear."""
    if not curves:
        return
    exponent = float(np.median([curve.exponent for curve in curves]))
    worse = float(np.median([curve.times_worse for curve in curves]))
    least, most = _EXACTLY_LINEAR if all(curve.exact for curve in curves) else _LINEAR
    if least < exponent < most or worse < _CLEAR:
        return
    words = (
        f"frames are declared linear, but values to the power {exponent:.1f} explain them {worse:.1f} "
        "times better; give the colour space that they are in"
    )
    figures = {"exponent": round(exponent, 2), "times_better": round(worse, 2), "cameras": len(curves)}
    yield Finding("error", "gamma", subject, words, figures=figures)
