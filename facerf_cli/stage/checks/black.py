"""Frames without a picture in them: black throughout, or one value throughout."""

from collections.abc import Iterator

import numpy as np

from facerf_cli.stage.checks.findings import Finding
from facerf_cli.stage.checks.frames import CameraFrames
from facerf_cli.stage.checks.stereo import reaches_face

_BLACK = 1e-3  # of what the camera's frames reach in the median: below any lamp that reaches any skin
_FLAT = 1e-6  # of its maximum


def check_black(frames: CameraFrames) -> Iterator[Finding]:
    """A finding for each black or flat frame, and one for a camera that has no others.

    A lamp behind the head may light nothing that the camera sees: such a frame is nearly black by right, so
    only a lamp that is neither far behind nor far below makes a dark frame a black one. A flat frame is none
    under any lamp.
    """
    if not frames.figures:
        return
    highest = np.array([figures.highest for figures in frames.figures])
    usual = float(np.median(highest))
    if usual <= 0:
        words = "most frames are black; was the lens cap on, or is black_level too high?"
        yield Finding("error", "black", frames.subject, words, frames.camera)
        return
    flat = np.array([figures.spread <= _FLAT * max(figures.highest, 0) for figures in frames.figures])
    black = (highest < _BLACK * usual) & reaches_face(frames.directions)
    for row in np.flatnonzero(black | flat):
        figures = {"highest": float(highest[row]), "usual": usual}
        words = "is black" if highest[row] < _BLACK * usual else "has one value throughout"
        words += "; the shutter, the lamp or the writing of the file failed"
        yield Finding(
            "error", "black", frames.subject, words, frames.camera, frames.light_ids[row], figures, True
        )
