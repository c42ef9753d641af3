"""Frames made of two video fields under different lamps: odd rows are lit otherwise than even ones."""

from collections.abc import Iterator

import numpy as np

from facerf_cli.stage.checks.findings import Finding
from facerf_cli.stage.checks.frames import CameraFrames
from facerf_cli.stage.checks.stereo import reaches_face

# Sound frames of Extended Yale B's subjects 05, 15 and 22 have ratios within 1.3 times their median, those of
# a dozen lamps far apart up to 3; the two broken ones there are 78 and 184 times above it, a planted one 7.
_TIMES_USUAL = 5.0
_NEIGHBOURS = 6
_COMB = 0.01  # of the mean: below it, noise may do it and nobody is harmed


def check_fields(frames: CameraFrames) -> Iterator[Finding]:
    """A finding for each frame whose rows alternate far more than its columns do, against other frames.

    Hair alternates too, under lamps from above: the lamps next to a frame's are what it is held against.
    Lamps behind the head light rims one row wide and are not judged.
    """
    if len(frames.figures) < 3:
        return
    ratios = np.array([figures.comb_ratio for figures in frames.figures])
    combs = np.array([figures.comb for figures in frames.figures])
    near = np.argsort(-frames.directions @ frames.directions.T, axis=1)[:, 1 : 1 + _NEIGHBOURS]
    usual = np.maximum(np.median(ratios[near], axis=1), max(float(np.median(ratios)), 1.0))
    broken = (ratios > _TIMES_USUAL * usual) & (combs > _COMB) & reaches_face(frames.directions)
    for row in np.flatnonzero(broken):
        times = float(ratios[row] / usual[row])
        figures = {"times_usual": round(times, 2), "comb": round(float(combs[row]), 4)}
        words = (
            f"odd and even rows are lit differently ({combs[row]:.1%} of the mean, "
            f"{times:.0f} times the usual); two video fields under two lamps?"
        )
        yield Finding(
            "error", "fields", frames.subject, words, frames.camera, frames.light_ids[row], figures, True
        )
