"""Faces in a photo: their boxes, and 68 landmarks (Multi-PIE order), found or read from a file.

Positions are in the photo's pixels with pixel centres at index + `PIXEL_CENTRE` (`raster/camera.py`).
"""

import math
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

import numpy as np

from facerf_cli.errors import InputError, UsageError
from facerf_cli.face.crop import Box, check_landmarks
from facerf_cli.files.documents import Document, Points68, checked
from facerf_cli.files.json_reader import read_json
from facerf_cli.files.regular import require_regular
from facerf_cli.image.colour import auto_exposure_ev, linear_to_srgb
from facerf_cli.image.strips import strips

_MAX_BYTES = 1 << 20  # of a landmark file
_BLOCK_PX = 1 << 16  # converted at a time, so that they stay in the processor's cache
_ADVICE = "give 68 landmarks as .pts or JSON"
_PTS_FIRST_PIXEL = 0.5  # .pts counts pixels from 1: the first pixel's centre is 1.0 there and 0.5 here


@dataclass(frozen=True)
class FaceBox:
    """A face in a photo: its box (left, top, right, bottom) in the photo's pixels."""

    box_px: Box
    score: float

    @property
    def area_px(self) -> float:
        """The area of the box."""
        left, top, right, bottom = self.box_px
        return (right - left) * (bottom - top)


@dataclass(frozen=True)
class Face(FaceBox):
    """A face with its landmarks [68, 2] in the photo's pixels."""

    landmarks_px: np.ndarray

    @property
    def box(self) -> FaceBox:
        """The face without its landmarks."""
        return FaceBox(self.box_px, self.score)


def face_at(landmarks_px: np.ndarray) -> Face:
    """The face of given landmarks [68, 2], in their bounds."""
    (left, top), (right, bottom) = landmarks_px.min(0).tolist(), landmarks_px.max(0).tolist()
    return Face((left, top, right, bottom), math.inf, landmarks_px)


Found = TypeVar("Found", bound=FaceBox)


def choose_face(faces: list[Found], which: str, name: str) -> list[Found]:
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


def to_display(pixels_linear: np.ndarray, exposure_ev: float | None = None) -> np.ndarray:
    """Convert a scene-linear image [H, W, 3] to sRGB uint8, at `display_ev` where no exposure is given."""
    gain = np.float32(2.0 ** (display_ev(pixels_linear) if exposure_ev is None else exposure_ev))
    display = np.empty(pixels_linear.shape, np.uint8)
    for rows in strips(display.shape, _BLOCK_PX):
        encoded = linear_to_srgb((pixels_linear[rows] * gain).clip(0, 1))
        display[rows] = np.round(encoded * 255)
    return display


def display_ev(pixels_linear: np.ndarray) -> float:
    """The automatic exposure of an image [H, W, 3] in EV, by some of its pixels."""
    stride = max(1, max(pixels_linear.shape[:2]) // 1024)
    return auto_exposure_ev(pixels_linear[::stride, ::stride])


def check_display(image_srgb: np.ndarray) -> None:
    """Raise ValueError for anything but an sRGB uint8 image [H, W, 3], as `to_display` gives it."""
    if image_srgb.ndim != 3 or image_srgb.shape[2] != 3 or image_srgb.dtype != np.uint8:
        raise ValueError(f"image: it is {image_srgb.dtype} {image_srgb.shape}, not uint8 [H, W, 3]")


def read_landmarks(path: Path) -> np.ndarray:
    """Read landmarks [68, 2] in the photo's pixels; raises InputError for any other file.

    The file is iBUG's `.pts`, whose pixels count from 1, or JSON with pixel centres at index + 0.5: a list of
    68 [x, y], or an object with this list as "landmarks".
    """
    require_regular(path, _ADVICE)
    try:
        if path.suffix.lower() == ".pts":
            return check_landmarks(_read_pts(path))
        content = read_json(path, _ADVICE, _MAX_BYTES)
        points = (
            checked(_LandmarksDocument, content, str(path)).landmarks
            if isinstance(content, dict)
            else content
        )
        return check_landmarks(checked(Points68, points, str(path)))
    except InputError as error:
        named = "" if str(error).startswith(str(path)) else f"{path}: "
        raise InputError(f"{named}{error}") from None


class _LandmarksDocument(Document):
    landmarks: Points68


def _read_pts(path: Path) -> np.ndarray:
    try:
        with path.open("rb") as stream:
            _, opening, rest = stream.read(_MAX_BYTES).decode().partition("{")
        body, closing, _ = rest.partition("}")
        if not opening or not closing:
            raise ValueError("it has no points between { and }")
        rows = [[float(token) for token in line.split()] for line in body.splitlines() if line.strip()]
        return np.array(rows, np.float64) - _PTS_FIRST_PIXEL
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}); {_ADVICE}") from None
    except ValueError as error:
        raise InputError(f"{path}: no landmarks ({error}); {_ADVICE}") from None
