"""Frames of a camera as the checks see them, and the faults of single frames.

A frame may be missing, unreadable, black, clipped, another camera's, or of two interlaced fields. Each is
read once for all checks, and one full frame is in memory at a time.
"""

import hashlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
import torch.nn.functional as F

from facerf_cli.capture.capture import Capture, FrameSizeError, unlisted_kind
from facerf_cli.capture.findings import Finding
from facerf_cli.errors import InputError

_BRIGHT = 0.2  # of the brightest blocks: darker ones do not count in `comb`
_AT_THE_TOP = 1 - 1e-5  # of a frame's maximum: arithmetic may move clipped values this far apart
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
# Lights that head, body, hair or brows can hide from the face, in camera space.
_BEHIND = -0.5  # cosine to the camera's axis: the head hides lights further behind
_BELOW = -0.7  # sine of the elevation: the body hides lights further below
_ABOVE, _OVERHEAD = 0.85, 0.3  # sine above which hair or brows hide lights of a cosine below the second


@dataclass(frozen=True)
class FrameFigures:
    """Measurements of a full-size frame with recorded values, not divided by the light's intensity."""

    digest: str  # SHA-256 of the pixels
    highest: float  # largest value
    share_highest: float  # of the pixels with the largest value in some channel
    spread: float  # largest less smallest value
    comb: float  # relative difference between odd and even rows, see `comb`
    comb_ratio: float  # that over the difference between odd and even columns


@dataclass(frozen=True, eq=False)
class CameraFrames:
    """The readable frames of a subject in a camera, small and grey."""

    subject: str
    camera: str
    light_ids: tuple[str, ...]  # of the frames
    places: np.ndarray  # [L] indices into the capture's lights, ascending
    directions: np.ndarray  # [L, 3] unit, toward the lights, camera space
    grey: np.ndarray  # [L, h, w] float32 linear, under a light of rgb 1
    figures: tuple[FrameFigures, ...]
    scale: float  # pixels of the camera per pixel of `grey`

    def without(self, broken: set[str]) -> "CameraFrames":
        """Remove the frames under these lights."""
        kept = [row for row, light in enumerate(self.light_ids) if light not in broken]
        return replace(
            self,
            light_ids=tuple(self.light_ids[row] for row in kept),
            places=self.places[kept],
            directions=self.directions[kept],
            grey=self.grey[kept],
            figures=tuple(self.figures[row] for row in kept),
        )

    def error(self, check: str, words: str, row: int | None = None, **figures: float) -> Finding:
        """Make an error about the camera, or about the frame in a row, which is then left out."""
        light = "" if row is None else self.light_ids[row]
        return Finding("error", check, self.subject, words, self.camera, light, figures)

    def warning(self, check: str, words: str, **figures: float) -> Finding:
        """Make a warning about the camera."""
        return Finding("warning", check, self.subject, words, self.camera, figures=figures)


@dataclass(frozen=True)
class Unread:
    """A frame that could not be read."""

    light: str
    reason: str
    wrong_size: bool  # the file is sound, but not of the camera's size


def read_frames(
    capture: Capture, subject: str, camera: str, side_px: int
) -> tuple[CameraFrames, list[Unread]]:
    """Read the frames of a camera that exist, shrunk to `side_px`; return unreadable ones separately."""
    posed = capture.cameras[camera]
    scale = max(posed.width_px, posed.height_px, side_px) / side_px
    size = (max(round(posed.height_px / scale), 1), max(round(posed.width_px / scale), 1))
    places, greys, figures, unread = [], [], [], []
    for place, light in enumerate(capture.light_ids):
        if not capture.frame_path(subject, camera, light).exists():
            continue
        try:
            pixels = capture.frame(subject, camera, place)
        except InputError as error:
            unread.append(Unread(light, str(error), isinstance(error, FrameSizeError)))
            continue
        places.append(place)
        figures.append(_measure(pixels * capture.intensities[place].astype(np.float32)))
        greys.append(small(grey_of(pixels), size))
    rows = np.array(places, int)
    frames = CameraFrames(
        subject=subject,
        camera=camera,
        light_ids=tuple(capture.light_ids[place] for place in places),
        places=rows,
        directions=capture.directions_world[rows] @ posed.rotation.double().numpy().T,
        grey=np.stack(greys) if greys else np.zeros((0, *size), np.float32),
        figures=tuple(figures),
        scale=scale,
    )
    return frames, unread


def grey_of(pixels: np.ndarray) -> np.ndarray:
    """Mean of the channels [H, W]; numpy's mean is many times slower over an axis of three."""
    return (pixels[..., 0] + pixels[..., 1] + pixels[..., 2]) / np.float32(3)


def small(grey: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """Shrink a plane [H, W] by area averaging."""
    return F.interpolate(torch.from_numpy(grey)[None, None], size, mode="area")[0, 0].numpy()


def _measure(pixels: np.ndarray) -> FrameFigures:
    """Measure a frame [H, W, 3] at full size."""
    highest, grey = float(pixels.max()), grey_of(pixels)
    rows, columns = comb(grey), comb(grey.T)
    top = (pixels >= highest * _AT_THE_TOP).any(-1) if highest > 0 else np.zeros(1)
    return FrameFigures(
        digest=hashlib.sha256(pixels.tobytes()).hexdigest(),
        highest=highest,
        share_highest=float(top.mean()),
        spread=highest - float(pixels.min()),
        comb=rows,
        comb_ratio=rows / max(columns, 1e-6),
    )


def comb(grey: np.ndarray) -> float:
    """Relative difference between odd and even rows of an image [H, W], as the median of bright blocks.

    A row's deviation from the mean of its neighbours, with alternating sign, adds up over a block of 8 x 4
    pixels only if rows alternate. Blocks are small because rows of a resampled image alternate in phase only
    locally.
    """
    departure = grey[1:-1] - (grey[:-2] + grey[2:]) / 2
    departure = departure * np.where(np.arange(len(departure)) % 2, -1, 1)[:, None]
    if len(departure) < 8 or departure.shape[1] < 4:
        return 0.0
    mean = _blocks(grey[1:-1])
    bright = mean > max(_BRIGHT * float(np.percentile(mean, 95)), 0)
    return float(np.median(np.abs(_blocks(departure))[bright] / mean[bright])) if bright.any() else 0.0


def _blocks(plane: np.ndarray) -> np.ndarray:
    """Means of the complete blocks of 8 x 4 pixels."""
    height, width = plane.shape[0] // 8, plane.shape[1] // 4
    return plane[: height * 8, : width * 4].reshape(height, 8, width, 4).mean((1, 3))


def reaches_face(directions: np.ndarray) -> np.ndarray:
    """Mask [L] of directions [L, 3], camera space, that neither head, hair nor body hides from the face."""
    _, up, front = directions.T
    return (front > _BEHIND) & (up > _BELOW) & ~((up > _ABOVE) & (front < _OVERHEAD))


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
        yield Finding("error", "missing", subject, f"{paths[light]}: no such file; copy it", camera, light)
    if extra := extra_names(capture, subject, camera):
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
    files = [file.name for file in path.parent.glob("*") if file.is_file() and file.name[0] != "."]
    fitting = [name for name in files if name.startswith(prefix) and name.endswith(after)]
    names = {name[len(prefix) : len(name) - len(after)] for name in fitting} - {"", *capture.light_ids}
    return sorted(name for name in names if not unlisted_kind(name))


def check_readable(frames: CameraFrames, unread: Sequence[Unread]) -> Iterator[Finding]:
    """Report each unreadable frame; or the camera, where most frames have another size."""
    wrong = [frame for frame in unread if frame.wrong_size]
    if len(wrong) > _MOST_OF_ANOTHER_SIZE * (len(unread) + len(frames.light_ids)):
        words = (
            f"{len(wrong)} frames have another size than the camera ({wrong[0].reason}); correct the "
            "camera's width, height and K"
        )
        yield frames.error("resolution", words, frames=len(wrong))
        unread = [frame for frame in unread if not frame.wrong_size]
    for frame in unread:
        check = "resolution" if frame.wrong_size else "unreadable"
        yield Finding("error", check, frames.subject, frame.reason, frames.camera, frame.light)


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
        yield frames.error("black", "most frames are black; check the lens cap and black_level")
        return
    flat = np.array([figures.spread <= _FLAT * max(figures.highest, 0) for figures in frames.figures])
    dark = highest < _BLACK * usual
    for row in np.flatnonzero(dark & reaches_face(frames.directions) | flat).tolist():
        words = "is black" if dark[row] else "has one value throughout"
        words += "; check the shutter, the light and the file"
        yield frames.error("black", words, row, highest=float(highest[row]), usual=usual)


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
    yield frames.warning("clipped", words, frames=len(clipped), worst_share=round(float(share[worst]), 4))


def same_frames(frames: CameraFrames) -> list[list[int]]:
    """Groups of rows with identical images, among frames that have more than one value."""
    groups: dict[str, list[int]] = {}
    for row, figures in enumerate(frames.figures):
        if figures.spread > 0:
            groups.setdefault(figures.digest, []).append(row)
    return [rows for rows in groups.values() if len(rows) > 1]


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
        yield frames.error("duplicate", words, frames=len(again))


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
    for row in np.flatnonzero(broken).tolist():
        times = float(ratios[row] / usual[row])
        words = (
            f"has odd and even rows under different light ({combs[row]:.1%} of the mean, {times:.0f} times "
            "the usual), as from two video fields; take it again"
        )
        measured = {"times_usual": round(times, 2), "comb": round(float(combs[row]), 4)}
        yield frames.error("fields", words, row, **measured)
