"""Faults of single frames: missing, unreadable, black, clipped, duplicate, or of two interlaced fields."""

from collections.abc import Iterator, Mapping, Sequence

import numpy as np

from facerf_cli.capture.capture import Capture
from facerf_cli.capture.checks.findings import Finding
from facerf_cli.capture.checks.frames import CameraFrames, Unread
from facerf_cli.capture.checks.stereo import Stereo, reaches_face
from facerf_cli.capture.pattern import unlisted_kind

_LISTED = 3  # file names of a message
_MOST_OF_ANOTHER_SIZE = 0.5  # of a camera's frames: with more, the camera's description is wrong
_BLACK = 1e-3  # of the median of the frames' maxima: less than any light on skin leaves
_FLAT = 1e-6  # of a frame's maximum
_CLIPPED_SHARE = 0.01  # of the pixels: highlights on skin are smaller, a clipped cheek is larger
_CEILING = 1e-4  # relative distance within which values count as the ceiling
# Sound frames of Extended Yale B's subjects 05, 15 and 22 have ratios within 1.3 times their median, those of
# a dozen lights far apart up to 3; the two broken ones there are 78 and 184 times above it, a planted one 7.
_TIMES_USUAL = 5.0
_NEIGHBOURS = 6
_COMB = 0.01  # of the mean: smaller differences may be noise, and do no harm


def check_missing(capture: Capture, subject: str, camera: str) -> Iterator[Finding]:
    """Report each missing frame of a camera; a camera without frames, or extra files, as one warning."""
    paths = {light: capture.frame_path(subject, camera, light) for light in capture.light_ids}
    missing = [light for light, path in paths.items() if not path.is_file()]
    if len(missing) == len(paths):
        example = next(iter(paths.values()))
        words = f"has no frames ({example}, ...); copy them, or correct the pattern"
        yield Finding("warning", "missing", subject, words, camera)
        missing = []
    for light in missing:
        words = f"{paths[light]}: no such file; copy it"
        yield Finding("error", "missing", subject, words, camera, light, {}, True)
    extra = extra_names(capture, subject, camera)
    if extra:
        names = ", ".join(extra[:_LISTED]) + (", ..." if len(extra) > _LISTED else "")
        words = f"{len(extra)} files are of no light in the list ({names}); list their lights, or remove them"
        yield Finding("warning", "extra", subject, words, camera, figures={"files": len(extra)})


def extra_names(capture: Capture, subject: str, camera: str) -> list[str]:
    """Names in the light's place of files that are of no light, sorted; without full and ambient images."""
    mark = "\x01"  # occurs in no name
    path = capture.frame_path(subject, camera, mark)
    if path.name.count(mark) != 1 or mark in str(path.parent):  # {light} is a folder's name, or stands twice
        return []
    prefix, after = path.name.split(mark)
    known, names = set(capture.light_ids), []
    for found in path.parent.glob("*"):
        name = found.name
        if found.is_file() and name.startswith(prefix) and name.endswith(after) and name[0] != ".":
            names.append(name[len(prefix) : len(name) - len(after)])
    others = (name for name in names if name and name not in known)
    return sorted(name for name in others if not unlisted_kind(name))


def check_readable(frames: CameraFrames, unread: Sequence[Unread]) -> Iterator[Finding]:
    """Report each unreadable frame; or the camera, where most frames have another size."""
    wrong = [frame for frame in unread if frame.wrong_size]
    if len(wrong) > _MOST_OF_ANOTHER_SIZE * (len(unread) + len(frames.light_ids)):
        words = (
            f"{len(wrong)} frames have another size than the camera ({wrong[0].reason}); correct the "
            "camera's width, height and K"
        )
        yield Finding(
            "error", "resolution", frames.subject, words, frames.camera, figures={"frames": len(wrong)}
        )
        unread = [frame for frame in unread if not frame.wrong_size]
    for frame in unread:
        check = "resolution" if frame.wrong_size else "unreadable"
        yield Finding("error", check, frames.subject, frame.reason, frames.camera, frame.light, {}, True)


def check_black(frames: CameraFrames) -> Iterator[Finding]:
    """Report each frame that is black or has one value throughout; or the camera, if most are black.

    A light behind the head may reach nothing that the camera sees. So a dark frame counts as black only under
    a light that reaches the face; a frame of one value is broken under any light.
    """
    if not frames.figures:
        return
    highest = np.array([figures.highest for figures in frames.figures])
    usual = float(np.median(highest))
    if usual <= 0:
        words = "most frames are black; check the lens cap and black_level"
        yield Finding("error", "black", frames.subject, words, frames.camera)
        return
    flat = np.array([figures.spread <= _FLAT * max(figures.highest, 0) for figures in frames.figures])
    black = (highest < _BLACK * usual) & reaches_face(frames.directions)
    for row in np.flatnonzero(black | flat):
        figures = {"highest": float(highest[row]), "usual": usual}
        words = "is black" if highest[row] < _BLACK * usual else "has one value throughout"
        words += "; check the shutter, the light and the file"
        yield Finding(
            "error", "black", frames.subject, words, frames.camera, frames.light_ids[row], figures, True
        )


def check_clipped(frames: CameraFrames) -> Iterator[Finding]:
    """Warn once per camera of frames with large areas at the sensor's ceiling.

    The ceiling is the largest value of all frames, if two or more frames reach it: noise and highlights
    differ from frame to frame, a clipped sensor does not. EXR files declare no ceiling.
    """
    highest = np.array([figures.highest for figures in frames.figures])
    if len(highest) < 2:
        return
    at_ceiling = highest >= highest.max() * (1 - _CEILING)
    share = np.array([figures.share_highest for figures in frames.figures])
    clipped = np.flatnonzero(at_ceiling & (share > _CLIPPED_SHARE))
    if not len(clipped) or at_ceiling.sum() < 2:
        return
    worst = clipped[share[clipped].argmax()]
    words = (
        f"{len(clipped)} of {len(highest)} frames are clipped over more than {_CLIPPED_SHARE:.0%} of their "
        f"pixels ({frames.light_ids[worst]}: {share[worst]:.1%}); expose less"
    )
    figures = {"frames": len(clipped), "worst_share": round(float(share[worst]), 4)}
    yield Finding("warning", "clipped", frames.subject, words, frames.camera, figures=figures)


def same_frames(frames: CameraFrames) -> list[list[int]]:
    """Groups of rows with identical images, among frames that have more than one value."""
    groups: dict[str, list[int]] = {}
    for row, figures in enumerate(frames.figures):
        if figures.spread > 0:
            groups.setdefault(figures.digest, []).append(row)
    return [rows for rows in groups.values() if len(rows) > 1]


def check_duplicates(frames: CameraFrames, stereo: Stereo | None) -> Iterator[Finding]:
    """Report identical frames, except the one of each group whose light predicts the image best.

    `stereo` is fitted without these frames; if it is None, whole groups are reported.
    """
    for rows in same_frames(frames):
        own = None if stereo is None else _best_row(frames, stereo, rows)
        names = ", ".join(frames.light_ids[row] for row in rows)
        for row in rows:
            if row == own:
                continue
            words = f"is identical to other frames ({names})"
            words += "" if own is None else f" and fits light {frames.light_ids[own]} best"
            words += "; copy it again"
            figures = {"frames": len(rows)}
            light = frames.light_ids[row]
            yield Finding("error", "duplicate", frames.subject, words, frames.camera, light, figures, True)


def _best_row(frames: CameraFrames, stereo: Stereo, rows: list[int]) -> int:
    """Row whose predicted frame correlates best with the image that the rows share."""
    predicted = stereo.predicted(frames.directions[rows])
    image = frames.grey[rows[0]][stereo.lit]
    return rows[int(np.argmax([np.corrcoef(image, guess)[0, 1] for guess in predicted]))]


def check_other_cameras(frames: CameraFrames, earlier: Mapping[str, str]) -> Iterator[Finding]:
    """Report a camera with frames of another one; `earlier` has the others' camera/light by digest."""
    again = [
        (light, earlier[figures.digest])
        for light, figures in zip(frames.light_ids, frames.figures, strict=True)
        if figures.spread > 0 and figures.digest in earlier
    ]
    if again:
        light, place = again[0]
        words = f"{len(again)} frames are another camera's ({light} is identical to {place}); copy them again"
        figures = {"frames": len(again)}
        yield Finding("error", "duplicate", frames.subject, words, frames.camera, figures=figures)


def check_fields(frames: CameraFrames) -> Iterator[Finding]:
    """Report each frame whose rows alternate far more than its columns do, compared with other frames.

    Hair alternates too, under lights from above; so the frames of neighbouring lights set what is usual.
    Lights behind the head light edges one row wide, and are not judged.
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
            f"has odd and even rows under different light ({combs[row]:.1%} of the mean, {times:.0f} times "
            "the usual), as from two video fields; take it again"
        )
        yield Finding(
            "error", "fields", frames.subject, words, frames.camera, frames.light_ids[row], figures, True
        )
