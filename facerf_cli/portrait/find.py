"""People in a photo: their faces, each with landmarks and how sure they are, and what is seen around them.

dlib's HOG detector proposes squares, and so does the whole photo. The Parsing Network looks at each, and
again at the face that it sees there, upright, and at last from squares that differ a little; what it is not
sure of is dropped.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np

from facerf_cli.errors import InputError, UsageError
from facerf_cli.face.crop import GIVE_LANDMARKS, Box, box_of, from_landmarks
from facerf_cli.face.dlib_landmarks import detect_landmarks, detected_boxes
from facerf_cli.face.landmarks import check_display, to_display
from facerf_cli.face.topology import OUTER_EYE_CORNERS
from facerf_cli.network.parsing import ParsingNetwork
from facerf_cli.portrait.classes import class_index
from facerf_cli.portrait.parse import Square, SquareView, look

LandmarksFrom = Literal["facerf", "dlib"]
Word = Literal["sure", "unsure", "doubtful"]

_NO_FACE = "no face found; try a larger or brighter image that shows the whole face"
_FACE_SIDES = 1.7  # side of the square that landmarks are read from, in extents of the landmarks
# Sides (in extents) and turns of further squares whose landmarks the last ones are averaged with.
_MORE_SIDES, _MORE_TURNS_RAD = (1.5, 1.9), (0.12, -0.12)
_BOX_SIDES = 1.9  # side of the first square, in sides of a detector's box
_LEAST_PRESENCE = 0.5  # of a face
_MOST_ERROR, _SURE_ERROR = 0.06, 0.018  # expected, of a face and of a sure one, in extents of the landmarks
_SAME = 0.35  # overlap over union from which on two boxes hold one face
_DETECTOR_PX = 1280  # longest side of the image that the detector looks at
_TURNS = (math.pi / 2, -math.pi / 2, math.pi)
_BEYOND = 1.6  # side of a square around a face that is larger than the photo, in sides of the photo
_TILES = 3  # along each side of the photo, half as large as it
_SURE, _UNSURE = 0.6, 0.35  # least scores of the words
_SMALL_PX, _LARGE_PX = 40.0, 160.0  # extents of a face that is too small, and large enough
_NARROW, _FRONTAL = 0.15, 0.4  # distance of the eyes over the face's extent, in profile and from the front
_OFF = 0.05  # expected error of the landmarks, in extents, at which they are worthless
_BLURRED, _SHARP = 0.12, 0.24  # sharpness of a face without detail, and with enough of it
SUPPORTED_YAW_DEG, _LOST_YAW_DEG = 45.0, 75.0  # turn of a head that the fit supports, and that it loses
_COVERING = ("glasses", "hand", "headwear")


@dataclass(frozen=True, eq=False)
class FaceBox:
    """A face in a photo: its box in the photo's pixels, and what the Parsing Network sees around it.

    There is no view of a face that was given, or found by dlib.
    """

    box_px: Box
    score: float
    view: SquareView | None = field(default=None, kw_only=True)

    @property
    def area_px(self) -> float:
        """The area of the box."""
        left, top, right, bottom = self.box_px
        return (right - left) * (bottom - top)


@dataclass(frozen=True, eq=False)
class Face(FaceBox):
    """A face with its landmarks [68, 2] in the photo's pixels; `view` also holds others, and their errors."""

    landmarks_px: np.ndarray

    @property
    def box(self) -> FaceBox:
        """The face without its landmarks."""
        return FaceBox(self.box_px, self.score, view=self.view)


def face_at(landmarks_px: np.ndarray) -> Face:
    """The face of given landmarks [68, 2], in their bounds."""
    (left, top), (right, bottom) = landmarks_px.min(0).tolist(), landmarks_px.max(0).tolist()
    return Face((left, top, right, bottom), math.inf, landmarks_px)


def choose_face(faces: list[Face], which: str, name: str) -> list[Face]:
    """Choose among faces ordered from left to right: the largest, all, or the one at an index from 0.

    'largest' multiplies size by detector score: a badge on a sleeve can be as large as the face above it.
    """
    if which == "all":
        return faces
    if which == "largest":
        return [max(faces, key=lambda face: face.area_px * face.score)]
    if not which.isdecimal():
        raise UsageError(f"--face {which}: not a choice; give largest, all or a number from 0")
    if int(which) >= len(faces):
        raise InputError(f"{name}: {len(faces)} face(s) found, --face {which} is not one; count from 0")
    return [faces[int(which)]]


def find_faces(
    parsing: ParsingNetwork,
    pixels_linear: np.ndarray,
    name: str,
    which: str = "largest",
    landmarks_from: LandmarksFrom = "facerf",
) -> list[Face]:
    """Find faces in a scene-linear image [H, W, 3]; `which` is largest, all or an index, see `choose_face`.

    Raises InputError, with the image's name, where no face is found.
    """
    faces = detect_faces(parsing, to_display(pixels_linear), landmarks_from, everyone=which != "largest")
    if not faces:
        raise InputError(f"{name}: {_NO_FACE}, or {GIVE_LANDMARKS}")
    return choose_face(faces, which, name)


def detect_faces(
    parsing: ParsingNetwork,
    image_srgb: np.ndarray,
    landmarks_from: LandmarksFrom = "facerf",
    everyone: bool = False,
) -> list[Face]:
    """Find the faces in an sRGB uint8 image [H, W, 3], ordered from left to right; empty for none.

    Turned faces, and ones that only a part of the photo shows well, are looked for where no upright one is
    sure, or for `everyone`; dlib's detector always looks for all. Where no face at all is sure, the surest
    alone is returned.
    """
    check_display(image_srgb)
    if landmarks_from == "dlib":
        return [Face(*found) for found in detect_landmarks(image_srgb)]
    found: list[SquareView] = []
    for squares in _attempts(image_srgb):
        views = [one for one in look(parsing, image_srgb, squares) if _is_face(one, image_srgb)]
        refined = [again for one in _distinct(views) if (again := _refined(parsing, image_srgb, one))]
        found = _distinct([*found, *refined])
        if not everyone and _sure(found):
            break
    faces = map(_as_face, _sure(found) or found[:1])
    return sorted(faces, key=lambda face: face.box_px[0])


def face_near(parsing: ParsingNetwork, image_srgb: np.ndarray, landmarks_px: np.ndarray) -> Face | None:
    """Find the face that was at landmarks [68, 2] a frame ago in an sRGB uint8 image [H, W, 3]; or None."""
    check_display(image_srgb)
    (view,) = look(parsing, image_srgb, [_around(landmarks_px)])
    again = _refined(parsing, image_srgb, view) if _is_face(view, image_srgb) else None
    return _as_face(again) if again else None


def _sure(found: list[SquareView]) -> list[SquareView]:
    return [one for one in found if one.relative_error <= _SURE_ERROR]


def _attempts(image: np.ndarray) -> Iterator[list[Square]]:
    """Squares to look at, the likeliest first."""
    yield [*map(_square, detected_boxes(image, _DETECTOR_PX)), _whole(image)]
    yield [_whole(image, sides=_BEYOND), *(_whole(image, turn_rad) for turn_rad in _TURNS)]
    yield _tiles(image)


def _refined(parsing: ParsingNetwork, image: np.ndarray, view: SquareView) -> SquareView | None:
    """Look twice more at a face, large and upright; None where it turns out to be none."""
    for last in (False, True):
        view = look(parsing, image, [_around(view.landmarks_px[:68])], mirrored=last)[0]
        if not _is_face(view, image):
            return None
    if view.relative_error > _MOST_ERROR:
        return None
    landmarks_px = view.landmarks_px[:68]
    others = (_around(landmarks_px, *pair) for pair in zip(_MORE_SIDES, _MORE_TURNS_RAD, strict=True))
    return averaged([view, *look(parsing, image, list(others))])


def averaged(views: list[SquareView]) -> SquareView:
    """The first view of a face, with the landmarks of all, weighed by the inverse squares of their errors."""
    weights = np.stack([view.error_px**-2.0 for view in views])[..., None]
    places = np.stack([view.landmarks_px for view in views])
    return replace(views[0], landmarks_px=(weights * places).sum(0) / weights.sum(0))


def _as_face(view: SquareView) -> Face:
    landmarks_px = view.landmarks_px[:68]
    return Face(box_of(from_landmarks(landmarks_px, 1)), _score(view), landmarks_px, view=view)


def _score(view: SquareView) -> float:
    """Rate from 0 to 1 how surely a face is there and well seen."""
    return view.presence * math.exp(-view.relative_error / _MOST_ERROR)


def _is_face(view: SquareView, image: np.ndarray) -> bool:
    """Tell if a head is there, with its middle in the photo."""
    x_px, y_px = view.landmarks_px[:68].mean(0)
    inside = 0 <= x_px <= image.shape[1] and 0 <= y_px <= image.shape[0]
    return bool(view.presence >= _LEAST_PRESENCE and inside)


def _around(face: np.ndarray, sides: float = _FACE_SIDES, more_rad: float = 0.0) -> Square:
    """The square that shows a face with landmarks [68, 2] large and upright, or turned a little more."""
    left, right = face[list(OUTER_EYE_CORNERS)]
    turn_rad = -math.atan2(right[1] - left[1], right[0] - left[0])
    upright = Square.around(face, sides)
    return replace(upright, side_px=max(upright.side_px, 1.0), turn_rad=turn_rad + more_rad)


def _square(box_px: Box) -> Square:
    left, top, right, bottom = box_px
    return Square((left + right) / 2, (top + bottom) / 2, _BOX_SIDES * (right - left + bottom - top) / 2)


def _whole(image: np.ndarray, turn_rad: float = 0.0, sides: float = 1.0) -> Square:
    height, width = image.shape[:2]
    return Square(width / 2, height / 2, float(max(height, width)) * sides, turn_rad)


def _tiles(image: np.ndarray) -> list[Square]:
    """Overlapping squares that cover the photo."""
    height, width = image.shape[:2]
    side_px = max(height, width) / 2
    columns, rows = (
        np.linspace(min(side_px, length) / 2, length - min(side_px, length) / 2, _TILES)
        for length in (width, height)
    )
    return [Square(float(x), float(y), side_px) for y in np.unique(rows) for x in np.unique(columns)]


def _distinct(views: list[SquareView]) -> list[SquareView]:
    """Faces, the surest first, without the less sure ones of those that lie on each other."""
    kept: list[SquareView] = []
    for face in sorted(views, key=lambda one: -_score(one)):
        if all(_overlap(face, other) < _SAME for other in kept):
            kept.append(face)
    return kept


def _overlap(first: SquareView, second: SquareView) -> float:
    """Area that the bounds of the landmarks of two faces share, over that of both together."""
    lows, highs = zip(
        *((x.landmarks_px[:68].min(0), x.landmarks_px[:68].max(0)) for x in (first, second)), strict=True
    )
    shared = float((np.minimum(*highs) - np.maximum(*lows)).clip(0).prod())
    areas = [float((high - low).prod()) for low, high in zip(lows, highs, strict=True)]
    return shared / max(sum(areas) - shared, 1e-9)


@dataclass(frozen=True)
class Confidence:
    """A score in 0..1, a product of factors by name; `word` and `reason` say it in words."""

    factors: dict[str, float]

    @property
    def score(self) -> float:
        """The score."""
        return float(np.prod(list(self.factors.values())))

    @property
    def word(self) -> Word:
        """The score in one word."""
        return "sure" if self.score >= _SURE else "unsure" if self.score >= _UNSURE else "doubtful"

    @property
    def reason(self) -> str:
        """The factor that weighs most."""
        return min(self.factors, key=lambda name: self.factors[name])


def confidence_in(view: SquareView, yaw_deg: float = 0.0) -> Confidence:
    """Rate a view of a face: how sure its landmarks are, its size and sharpness, its turn and what covers it.

    `yaw_deg` is the turn of the head that was fitted to it.
    """
    extent_px = view.extent_px
    left, right = view.landmarks_px[list(OUTER_EYE_CORNERS)]
    eyes = float(np.linalg.norm(right - left)) / max(extent_px, 1e-6)
    middle = view.classes[:, view.classes.shape[1] // 4 : -(view.classes.shape[1] // 4)]
    middle = middle[..., middle.shape[-1] // 4 : -(middle.shape[-1] // 4)]
    covered = float(middle[[class_index(name) for name in _COVERING]].sum(0).mean())
    return Confidence(
        {
            "unclear": view.presence * _ramp(view.relative_error, _OFF, 0.3 * _OFF),
            "small": _ramp(extent_px, _SMALL_PX, _LARGE_PX),
            "blurred": _ramp(view.sharpness, _BLURRED, _SHARP),
            "profile": _ramp(eyes, _NARROW, _FRONTAL),
            "covered": _ramp(covered, 0.6, 0.1),
            "turned": _ramp(abs(yaw_deg), _LOST_YAW_DEG, SUPPORTED_YAW_DEG),
        }
    )


def _ramp(value: float, worst: float, best: float) -> float:
    """From 0.1 at the worst value to 1 at the best."""
    return 0.1 + 0.9 * float(np.clip((value - worst) / (best - worst), 0, 1))
