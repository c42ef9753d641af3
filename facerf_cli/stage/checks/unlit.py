"""Lamps that did not fire: frames far darker than the other frames predict."""

from collections.abc import Iterator

import numpy as np

from facerf_cli.stage.checks.findings import Finding
from facerf_cli.stage.checks.frames import CameraFrames
from facerf_cli.stage.checks.stereo import Stereo, reaches_face

# Sound frames of Extended Yale B's subjects 05, 15 and 22 have 0.77 of what their neighbours have or more,
# those of synthetic faces 0.41, where the lamp can be judged; one that did not fire leaves some hundredths.
_LEAST_GAIN = 0.3
_REACH = 0.3  # of what the best placed lamps bring: with less, cast shadows and the room decide
_NEIGHBOURS = 6
_PLACES = 98  # per cent of the places are darker than those that are looked at


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
    """What each lamp should bring to the brightest places [L], and the share of it that is there [L].

    Hair or a hand may hide a lamp from most of the face; some place, a nose's tip, it reaches nearly always.
    """
    lamp = stereo.lamp(frames.directions)
    there = frames.grey[:, stereo.lit] - stereo.room
    bright, expected = (np.percentile(values, _PLACES, axis=1) for values in (there, lamp))
    return expected, bright / np.maximum(expected, 1e-12)
