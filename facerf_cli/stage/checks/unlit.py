"""Lamps that did not fire: frames far darker than the other frames predict."""

from collections.abc import Iterator

import numpy as np

from facerf_cli.stage.checks.findings import Finding
from facerf_cli.stage.checks.frames import CameraFrames
from facerf_cli.stage.checks.stereo import Stereo, reaches_face

# Sound frames of Extended Yale B's subjects 05, 15 and 22 keep 0.6 of what their neighbours have, where the
# lamp can be judged; a lamp that did not fire leaves the room's light, some hundredths. Between lies:
_LEAST_GAIN = 0.3
_REACH = 0.1  # of what the best placed lamps bring: with less, cast shadows and the room decide
_NEIGHBOURS = 6


def check_unlit(frames: CameraFrames, stereo: Stereo) -> Iterator[Finding]:
    """A finding for each frame whose lamp brings far less, over its prediction, than its neighbours' do."""
    lamp, gains = gains_of(frames, stereo)
    judged = lamp > _REACH * np.percentile(lamp, 95)
    judged &= reaches_face(frames.directions)
    if judged.sum() <= _NEIGHBOURS:
        return
    rows = np.flatnonzero(judged)
    cosines = frames.directions[rows] @ frames.directions[rows].T
    np.fill_diagonal(cosines, -2)
    neighbours = rows[np.argsort(-cosines, axis=1)[:, :_NEIGHBOURS]]
    for row, usual in zip(rows, np.median(gains[neighbours], axis=1), strict=True):
        if gains[row] < _LEAST_GAIN * usual:
            share = max(float(gains[row] / usual), 0.0)
            words = f"has {share:.0%} of the lamp's light that its neighbours predict; did the lamp fire?"
            figures = {"share": round(share, 3), "mean": float(frames.grey[row].mean())}
            light = frames.light_ids[row]
            yield Finding("error", "unlit", frames.subject, words, frames.camera, light, figures, True)


def gains_of(frames: CameraFrames, stereo: Stereo) -> tuple[np.ndarray, np.ndarray]:
    """What each lamp should bring in the mean [L], and how much of it is there [L], the room taken off."""
    lamp = stereo.lamp(frames.directions).mean(1)
    there = frames.grey[:, stereo.lit].mean(1) - stereo.room.mean()
    return lamp, there / np.maximum(lamp, 1e-12)
