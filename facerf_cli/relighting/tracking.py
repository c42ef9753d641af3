"""Cuts of a video, one face tracked through the frames of a shot, and its smoothed path.

Curves are smoothed by a local quadratic (Savitzky and Golay, *Smoothing and differentiation of data by
simplified least squares procedures*, 1964) with weights, so that missing or uncertain frames have little or
no influence. The filter has no delay and preserves a movement that is a parabola over the window.
"""

from collections import deque
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import chain, pairwise

import numpy as np
import torch
import torch.nn.functional as F

from facerf_cli.network.stored_graph import PeopleNetworks
from facerf_cli.portrait.find import Face, choose_face, detect_faces, face_near

_ROWS, _COLUMNS = 12, 16  # of a thumbnail
_LEAST = 0.05  # least change at a cut, display values in 0..1
_TIMES = 3.0  # change at a cut over the largest change around it
_AROUND = 3  # frames on each side


def with_cuts(images: Iterable[np.ndarray]) -> Iterator[tuple[np.ndarray, bool]]:
    """Yield the frames of a video, sRGB uint8 [H, W, 3], in order, and True where a new shot begins."""
    changes: list[float] = []  # from each frame to the next
    ahead: deque[np.ndarray] = deque()
    before: np.ndarray | None = None
    for number, image in enumerate(chain(images, [None] * _AROUND), -_AROUND):
        if image is not None:
            now = thumbnail(image)
            if before is not None:
                changes.append(float(np.abs(now - before).mean()))
            before = now
            ahead.append(image)
        if number >= 0:
            at = number - 1
            around = changes[max(at - _AROUND, 0) : max(at, 0)] + changes[number : number + _AROUND]
            yield ahead.popleft(), number > 0 and is_cut(changes[at], around)


def is_cut(change: float, around: Sequence[float]) -> bool:
    """Return True if a change is a cut, given the changes of the frames around it."""
    return change > max(_LEAST, _TIMES * max(around, default=0.0))


def thumbnail(image_srgb: np.ndarray) -> np.ndarray:
    """Return the means [_ROWS, _COLUMNS, 3] in 0..1 of the blocks of an image, uint8 [H, W, 3]."""
    pixels = torch.from_numpy(image_srgb).permute(2, 0, 1)[None].float() / 255
    return F.adaptive_avg_pool2d(pixels, (_ROWS, _COLUMNS))[0].permute(1, 2, 0).numpy()


LONGEST_GAP = 12  # frames without the face that are bridged: half a second at 24 frames per second
_FURTHEST = 1.5  # extents of its landmarks that a face may move while it is lost
_SIZES = (0.6, 1.7)  # range of the change of its size meanwhile


@dataclass(frozen=True, eq=False)
class Sighting:
    """Face in one frame."""

    landmarks_px: np.ndarray  # [68, 2]
    error: float  # median expected error of the landmarks, in their extents


class FaceTracker:
    """Track one face from frame to frame; `which` selects it: largest, or an index from the left."""

    def __init__(self, people: PeopleNetworks, which: str) -> None:
        self._people, self._which = people, which
        self._last: np.ndarray | None = None

    def track(self, image_srgb: np.ndarray) -> Sighting | None:
        """Find the face in the next frame, sRGB uint8 [H, W, 3]; return None if it is not visible.

        The face is searched near its last position, then in the whole frame. There, the nearest face of about
        the same size is used.
        """
        last = self._last
        face = None if last is None else face_near(self._people, image_srgb, last)
        if face is None or last is None or not _may_be(face, last):
            face = self._search(image_srgb)
        if face is None:
            return None
        self._last = face.landmarks_px
        return Sighting(face.landmarks_px, face.view.relative_error if face.view else 0.0)

    def _search(self, image_srgb: np.ndarray) -> Face | None:
        last = self._last
        faces = detect_faces(self._people, image_srgb, last is not None or self._which != "largest")
        if last is None:
            few = self._which.isdecimal() and int(self._which) >= len(faces)
            return None if few or not faces else choose_face(faces, self._which, "frame")[0]
        near = [face for face in faces if _may_be(face, last)]
        return min(near, key=lambda face: _apart_px(face.landmarks_px, last), default=None)


def _may_be(face: Face, last: np.ndarray) -> bool:
    """Return True if this may be the face that was last seen at landmarks [68, 2]."""
    before, now = _extent_px(last), _extent_px(face.landmarks_px)
    low, high = _SIZES
    return low < now / before < high and _apart_px(face.landmarks_px, last) < _FURTHEST * before


def _apart_px(one: np.ndarray, other: np.ndarray) -> float:
    return float(np.linalg.norm(one.mean(0) - other.mean(0)))


def _extent_px(landmarks_px: np.ndarray) -> float:
    return max(float(np.ptp(landmarks_px, axis=0).max()), 1.0)


REACH = 5  # frames on each side of a curve's window
_FULL = 4  # frames with weight that a quadratic needs; fewer are fitted by a line or a mean
_BRIDGE_WEIGHT = 0.05  # of a frame in a gap


def path_of(sightings: Sequence[Sighting | None]) -> np.ndarray:
    """Return smoothed landmarks [N, 68, 2] of a shot, NaN where the face is lost; short gaps are bridged."""
    path = np.full((len(sightings), 68, 2), np.nan)
    weights = np.zeros(len(sightings))
    for frame, sighting in enumerate(sightings):
        if sighting is not None:
            path[frame], weights[frame] = sighting.landmarks_px, 1.0
    for first, last in gaps(sightings):
        if is_bridged(first, last, len(sightings)):
            progress = (np.arange(first, last + 1) - first + 1)[:, None, None] / (last - first + 2)
            path[first : last + 1] = path[first - 1] + progress * (path[last + 1] - path[first - 1])
            weights[first : last + 1] = _BRIDGE_WEIGHT
    kept = (weights > 0)[:, None, None]
    return np.where(kept, smoothed(np.where(kept, path, 0), weights), np.nan)


def gaps(sightings: Sequence[Sighting | None]) -> Iterator[tuple[int, int]]:
    """Yield the first and last frame of each run of frames without the face."""
    sighted = [-1, *(frame for frame, one in enumerate(sightings) if one is not None), len(sightings)]
    return ((before + 1, after - 1) for before, after in pairwise(sighted) if after > before + 1)


def is_bridged(first: int, last: int, count: int) -> bool:
    """Return True if a gap in a shot of `count` frames is filled in from the frames around it."""
    return first > 0 and last + 1 < count and last - first < LONGEST_GAP


def smoothed(values: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Smooth curves [N, ...] with weights [N] >= 0 by local quadratics; NaN where a window has no weight.

    The window has `REACH` frames on each side, under a tricube (Cleveland, *Robust locally weighted
    regression and smoothing scatterplots*, 1979).
    """
    flat = values.reshape(len(values), -1).astype(np.float64)
    result = np.full_like(flat, np.nan)
    for frame in range(len(flat)):
        first, last = max(0, frame - REACH), min(len(flat), frame + REACH + 1)
        at = np.arange(first, last) - frame
        weight = weights[first:last] * (1 - (np.abs(at) / (REACH + 1)) ** 3) ** 3
        used = weight > 0
        if used.any():
            result[frame] = _local(at[used], flat[first:last][used], weight[used])
    return result.reshape(values.shape)


def _local(at: np.ndarray, values: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """Return the value [C] at time 0 of the polynomial that best fits values [M, C] at times [M]."""
    order = 2 if len(at) >= _FULL else min(1, len(at) - 1)
    columns = np.vander(at, order + 1, increasing=True) * np.sqrt(weight)[:, None]
    return np.asarray(np.linalg.lstsq(columns, values * np.sqrt(weight)[:, None], rcond=None)[0][0])
