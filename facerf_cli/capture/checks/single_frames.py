"""Frames without a picture in them: black throughout, or one value throughout.

Frames whose brightest pixels are cut off at the sensor's ceiling.

Frames that are the same picture, to the last bit: one of them was saved under another's name.

Frames made of two video fields under different lamps: odd rows are lit otherwise than even ones.

Frames that cannot be read, or whose size is not their camera's.
"""

from collections.abc import Iterator, Mapping, Sequence

import numpy as np

from facerf_cli.capture.checks.findings import Finding
from facerf_cli.capture.checks.frames import CameraFrames, Stereo, Unread, reaches_face

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
    image = frames.grey[rows[0]][stereo.lit]
    return rows[int(np.argmax([np.corrcoef(image, guess)[0, 1] for guess in predicted]))]


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


_MOST = 0.5  # of a camera's frames: when more have another size, it is the description that is wrong


def check_readable(frames: CameraFrames, unread: Sequence[Unread]) -> Iterator[Finding]:
    """A finding a frame; one for the whole camera where most frames have another size than it."""
    wrong = [frame for frame in unread if frame.wrong_size]
    if len(wrong) > _MOST * (len(unread) + len(frames.light_ids)):
        advice = "mend the camera's width, height and K"
        words = f"{len(wrong)} frames have another size than the camera; {advice} ({wrong[0].reason})"
        yield Finding(
            "error", "resolution", frames.subject, words, frames.camera, figures={"frames": len(wrong)}
        )
        unread = [frame for frame in unread if not frame.wrong_size]
    for frame in unread:
        check = "resolution" if frame.wrong_size else "unreadable"
        yield Finding("error", check, frames.subject, frame.reason, frames.camera, frame.light, {}, True)
