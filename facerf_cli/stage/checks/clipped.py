"""Frames whose brightest pixels are cut off at the sensor's ceiling."""

from collections.abc import Iterator

import numpy as np

from facerf_cli.stage.checks.findings import Finding
from facerf_cli.stage.checks.frames import CameraFrames

_SHARE = 0.01  # of the pixels: highlights on skin are smaller, a clipped cheek is larger
_CEILING = 1e-4  # how near to it counts as the ceiling


def check_clipped(frames: CameraFrames) -> Iterator[Finding]:
    """One warning a camera: how many frames have a plateau at the camera's ceiling.

    The ceiling is the highest value of all frames, if two frames have it at least: noise and highlights do
    not meet in one value, a sensor's end does. It is not known beforehand, for EXR has none.
    """
    highest = np.array([figures.highest for figures in frames.figures])
    if len(highest) < 2:
        return
    at_ceiling = highest >= highest.max() * (1 - _CEILING)
    share = np.array([figures.share_highest for figures in frames.figures])
    clipped = np.flatnonzero(at_ceiling & (share > _SHARE))
    if not len(clipped) or at_ceiling.sum() < 2:
        return
    worst = clipped[share[clipped].argmax()]
    words = (
        f"clipped over more than {_SHARE:.0%} of their pixels: {len(clipped)} of {len(highest)} frames "
        f"({frames.light_ids[worst]}: {share[worst]:.1%}); expose less, highlights are lost"
    )
    figures = {"frames": len(clipped), "worst_share": round(float(share[worst]), 4)}
    yield Finding("warning", "clipped", frames.subject, words, frames.camera, figures=figures)
