"""A display curve told by additivity: the sum of all lamps' frames is the frame with every lamp on.

The sharpest check of linearity there is, for it needs no model of the object; but few stages take the frame.
It is looked for in the place of a light, under one of `FULL_NAMES`.
"""

import numpy as np

from facerf_cli.errors import InputError
from facerf_cli.files.images import read_image
from facerf_cli.stage.checks.frames import CameraFrames, grey_of, small
from facerf_cli.stage.checks.gamma import EXPONENTS, Curve
from facerf_cli.stage.checks.missing import FULL_NAMES
from facerf_cli.stage.data.capture import Capture

_EXPONENTS = np.geomspace(EXPONENTS[0], EXPONENTS[-1], 80)  # a sharp minimum wants fine steps
_NOISE = 1e-3  # of log ratios: no sum is better than that
_DARK = 0.02  # of the brightest: darker pixels are noise


def added_exponent(capture: Capture, frames: CameraFrames) -> Curve | None:
    """The exponent under which the lamps' frames add up to the full one; None where there is no such frame.

    Only where all lamps' frames are there: a missing one would look like a curve.
    """
    full = _full_frame(capture, frames)
    if full is None or len(frames.light_ids) < len(capture.light_ids):
        return None
    strength = capture.intensities[frames.places].mean(1)[:, None]
    lit = full > _DARK * full.max()
    each = np.maximum(frames.grey[:, lit] * strength, 0).astype(float)
    together = full[lit].astype(float)
    errors = np.array([_error(each, together, exponent) for exponent in _EXPONENTS])
    at_one = _error(each, together, 1.0)
    return Curve(float(_EXPONENTS[errors.argmin()]), at_one / max(float(errors.min()), _NOISE), exact=True)


def _error(each: np.ndarray, together: np.ndarray, exponent: float) -> float:
    """How far the sum of decoded frames [L, P] is from the decoded full one [P]: median log ratio."""
    return float(np.median(np.abs(np.log((each**exponent).sum(0) + 1e-12) - exponent * np.log(together))))


def _full_frame(capture: Capture, frames: CameraFrames) -> np.ndarray | None:
    """The frame with every lamp on [h, w], as recorded less the black level."""
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
