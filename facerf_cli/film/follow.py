"""One face followed through the frames of a shot, and what is known of it where it is not seen."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from facerf_cli.face.landmarks import Face, choose_face
from facerf_cli.film.smoothing import smoothed
from facerf_cli.portrait.find import FoundFace, LandmarksFrom, detect_faces, face_near

LONGEST_GAP = 12  # frames without the face that are bridged: half a second at 24 frames a second
_FURTHEST = 1.5  # extents of its landmarks that a face may move while it is lost
_SIZES = (0.6, 1.7)  # range of the change of its size meanwhile
_BRIDGE_WEIGHT = 0.05  # of a frame in a gap


@dataclass(frozen=True, eq=False)
class Sighting:
    """A face in one frame: landmarks [68, 2] in pixels, and its median expected error, in their extent."""

    landmarks_px: np.ndarray
    error: float


class Follower:
    """Finds the same face in frame after frame; `last` are its landmarks [68, 2] where it was seen last."""

    def __init__(
        self, which: str, landmarks_from: LandmarksFrom = "facerf", last: np.ndarray | None = None
    ) -> None:
        self._which, self._from, self._last = which, landmarks_from, last

    def see(self, image_srgb: np.ndarray) -> Sighting | None:
        """Find the face in the next frame, sRGB uint8 [H, W, 3]; None where it is not seen.

        Near the place of the frame before, else in the whole frame: the one nearest to that place, of about
        its size. The first face is the one that `which` chooses: largest, or an index from the left.
        """
        face: Face | None = None
        if self._last is not None and self._from == "facerf":
            face = face_near(image_srgb, self._last)
            if face is not None and not _may_be(face, self._last):
                face = None
        if face is None:
            face = self._searched(image_srgb)
        if face is None:
            return None
        self._last = face.landmarks_px
        error = face.seen.relative_error if isinstance(face, FoundFace) else 0.0
        return Sighting(face.landmarks_px, error)

    def _searched(self, image_srgb: np.ndarray) -> Face | None:
        last = self._last
        faces = detect_faces(image_srgb, self._from, everyone=last is not None or self._which != "largest")
        if last is None:
            few = self._which.isdecimal() and int(self._which) >= len(faces)
            return None if few or not faces else choose_face(faces, self._which, "frame")[0]
        near = [face for face in faces if _may_be(face, last)]
        return min(near, key=lambda face: _apart_px(face.landmarks_px, last)) if near else None


def _may_be(face: Face, last: np.ndarray) -> bool:
    """Tell if a face can be the one that was at landmarks [68, 2]."""
    before, now = _extent_px(last), _extent_px(face.landmarks_px)
    low, high = _SIZES
    return low < now / before < high and _apart_px(face.landmarks_px, last) < _FURTHEST * before


def _apart_px(one: np.ndarray, other: np.ndarray) -> float:
    return float(np.linalg.norm(one.mean(0) - other.mean(0)))


def _extent_px(landmarks_px: np.ndarray) -> float:
    return max(float(np.ptp(landmarks_px, axis=0).max()), 1.0)


def path_of(sightings: Sequence[Sighting | None]) -> np.ndarray:
    """Smoothed landmarks [N, 68, 2] of a shot; NaN where the face is lost, but for gaps that are bridged."""
    path = np.full((len(sightings), 68, 2), np.nan)
    weights = np.zeros(len(sightings))
    for frame, seen in enumerate(sightings):
        if seen is not None:
            path[frame], weights[frame] = seen.landmarks_px, 1.0
    for first, last in gaps(sightings):
        if first > 0 and last + 1 < len(sightings) and last - first < LONGEST_GAP:
            share = (np.arange(first, last + 1) - first + 1)[:, None, None] / (last - first + 2)
            path[first : last + 1] = path[first - 1] + share * (path[last + 1] - path[first - 1])
            weights[first : last + 1] = _BRIDGE_WEIGHT
    kept = weights > 0
    found = smoothed(np.where(kept[:, None, None], path, 0), weights)
    return np.where(kept[:, None, None], found, np.nan)


def gaps(sightings: Sequence[Sighting | None]) -> Iterator[tuple[int, int]]:
    """First and last frames of each run of frames without the face."""
    first = None
    for frame, seen in enumerate([*sightings, Sighting(np.zeros((68, 2)), 0.0)]):
        if seen is None and first is None:
            first = frame
        elif seen is not None and first is not None:
            yield first, frame - 1
            first = None
