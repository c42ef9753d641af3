"""Frames that are the same picture, to the last bit: one of them was saved under another's name."""

from collections.abc import Iterator, Mapping

import numpy as np

from facerf_cli.stage.checks.findings import Finding
from facerf_cli.stage.checks.frames import CameraFrames
from facerf_cli.stage.checks.stereo import Stereo


def same_frames(frames: CameraFrames) -> list[list[int]]:
    """Groups of rows whose pictures are the same; frames without a picture are not counted."""
    groups: dict[str, list[int]] = {}
    for row, figures in enumerate(frames.figures):
        if figures.spread > 0:
            groups.setdefault(figures.digest, []).append(row)
    return [rows for rows in groups.values() if len(rows) > 1]


def check_duplicates(frames: CameraFrames, stereo: Stereo | None) -> Iterator[Finding]:
    """A finding for each frame of a group but the one whose lamp explains the picture best.

    `stereo` was fitted without any of them; without it nobody can tell, and all of a group are left out.
    """
    for rows in same_frames(frames):
        own = None if stereo is None else _best(frames, stereo, rows)
        names = ", ".join(frames.light_ids[row] for row in rows)
        for row in rows:
            if row == own:
                continue
            words = f"is the same picture as others ({names})"
            words += "" if own is None else f"; it is lit by {frames.light_ids[own]} rather"
            figures = {"frames": len(rows)}
            yield Finding(
                "error",
                "duplicate",
                frames.subject,
                words,
                frames.camera,
                frames.light_ids[row],
                figures,
                True,
            )


def _best(frames: CameraFrames, stereo: Stereo, rows: list[int]) -> int:
    """The row whose lamp's prediction is most like the picture."""
    predicted = stereo.predicted(frames.directions[rows])
    picture = frames.grey[rows[0]][stereo.lit]
    return rows[int(np.argmax([np.corrcoef(picture, guess)[0, 1] for guess in predicted]))]


def seen_before(frames: CameraFrames, earlier: Mapping[str, str]) -> Iterator[Finding]:
    """One error where frames of another camera (`earlier`: place by digest) are this camera's too."""
    again = [
        (light, earlier[figures.digest])
        for light, figures in zip(frames.light_ids, frames.figures, strict=True)
        if figures.spread > 0 and figures.digest in earlier
    ]
    if again:
        light, place = again[0]
        words = f"{len(again)} frames are those of another camera ({light} is {place}); copy them anew"
        figures = {"frames": len(again)}
        yield Finding("error", "duplicate", frames.subject, words, frames.camera, figures=figures)
