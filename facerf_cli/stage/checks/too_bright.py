"""Frames under lamps at the side or behind that are far too bright: those of a lamp in front, by their light.

Where a lamp in front lights the face, its direction can be solved for (`order.py`); behind, rims and hair are
lit, and only the frames under the lamps around tell how bright one may be.
"""

from collections.abc import Iterator

import numpy as np

from facerf_cli.stage.checks.findings import Finding
from facerf_cli.stage.checks.frames import CameraFrames
from facerf_cli.stage.checks.order import IN_FRONT
from facerf_cli.stage.checks.stereo import Stereo

_MOST = 2.5  # times the others; sound frames of synthetic faces have 1.5 at most, of Extended Yale B 1.1
_AROUND, _LEAST_AROUND = 0.7, 3  # cosine between lamps, and how many of them say something
_DARK = 0.05  # of the brightest frames: in darker ones noise and the room decide


def check_too_bright(frames: CameraFrames, stereo: Stereo) -> Iterator[Finding]:
    """A finding for each frame of a lamp that is not in front and is far brighter than those around it."""
    means = frames.grey[:, stereo.lit].mean(1)
    near = frames.directions @ frames.directions.T > _AROUND
    np.fill_diagonal(near, False)
    around = np.sort(np.where(near, means, 0), axis=1)[:, -2]  # of two that are swapped each has the other
    judged = (frames.directions[:, 2] <= IN_FRONT) & (near.sum(1) >= _LEAST_AROUND)
    judged &= means > _DARK * np.percentile(means, 95)
    for row in np.flatnonzero(judged & (means > _MOST * around)):
        times = float(means[row] / max(float(around[row]), 1e-12))
        brighter = f"is {min(times, 999):.0f} times as bright as the frames under the lamps around"
        words = f"{brighter}; was it saved under a wrong name?"
        light, figures = frames.light_ids[row], {"times": round(times, 1)}
        yield Finding("error", "order", frames.subject, words, frames.camera, light, figures, True)
