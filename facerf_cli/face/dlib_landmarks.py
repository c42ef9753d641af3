"""Faces by dlib, an extra: 68 landmarks (`--landmarks-from dlib`) and a descriptor of identity.

Boxes are found by a histogram of gradients and a linear classifier (Dalal and Triggs, *Histograms of oriented
gradients for human detection*, 2005). The licence of the landmarks' model
excludes commercial use. In dlib's positions and boxes the centre of a pixel is a whole number.
"""

import importlib
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

from facerf_cli.errors import FacerfError
from facerf_cli.face.crop import Box, Crop
from facerf_cli.face.topology import MIRROR_68
from facerf_cli.image.strips import block_means, resized
from facerf_cli.raster.camera import PIXEL_CENTRE

PREDICTOR_LICENCE = (
    "dlib shape_predictor_68_face_landmarks: trained on iBUG 300-W, whose licence excludes commercial use"
)
RECOGNITION_LICENCE = (
    "dlib_face_recognition_resnet_model_v1: in the public domain (Davis King); trained on FaceScrub, VGG "
    "Face, the web"
)
_MODELS_PACKAGE = "face_recognition_models"
_PREDICTOR_FILE = "shape_predictor_68_face_landmarks.dat"
_RECOGNITION_FILE = "dlib_face_recognition_resnet_model_v1.dat"

_BOX_PX, _CHIP_PX = 256, 640  # sizes of the face's box and of the image around it, as the predictor gets them
Found = tuple[Box, float, np.ndarray]  # a face's box, the detector's score and its landmarks [68, 2]
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


def detect_landmarks(image_srgb: np.ndarray) -> list[Found]:
    """Find the faces in an sRGB uint8 image [H, W, 3], ordered from left to right; empty for none."""
    for attempt in _ATTEMPTS:
        if faces := list(_detect(image_srgb, attempt)):
            doubtful = min(_DOUBTFUL_SCORE, max(score for _, score, _ in faces) / 3)
            return sorted((face for face in faces if face[1] >= doubtful), key=lambda face: face[0][0])
    return []


def _detect(image: np.ndarray, attempt: _Attempt) -> Iterator[Found]:
    """Run detector and predictor on one copy of the image; positions in the image's pixels."""
    turned = np.rot90(image, attempt.turns)
    height, width = turned.shape[:2]
    small = _reduced(turned, min(attempt.side_px / max(height, width), attempt.enlarge))
    curve = _brightened(small) if attempt.brighten else np.arange(256, dtype=np.uint8)
    pad = round(attempt.padding * max(small.shape[:2]))
    padded = np.ascontiguousarray(curve[np.pad(small, ((pad, pad), (pad, pad), (0, 0)), mode="edge")])
    to_photo = np.array([width / small.shape[1], height / small.shape[0]])
    rectangles, scores, _ = _detector().run(padded, 0, 0.0)
    for rectangle, score in zip(rectangles, scores, strict=True):
        low = (np.array([rectangle.left(), rectangle.top()]) - pad) * to_photo
        high = (np.array([rectangle.right(), rectangle.bottom()]) + 1 - pad) * to_photo
        centre = (low + high) / 2
        if (centre < 0).any() or (centre > (width, height)).any():
            continue
        corners = _turn_back(np.array([low, high]), attempt.turns, image.shape)
        (left, top), (right, bottom) = corners.min(0).tolist(), corners.max(0).tolist()
        landmarks = _predict(turned, centre, float((high - low).mean()), curve)
        box = (left, top, right, bottom)
        yield box, float(score), _turn_back(landmarks, attempt.turns, image.shape)


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
        box = _dlib().rectangle(round(x - half), round(y - half), round(x + half) - 1, round(y + half) - 1)
        found.append(_shape(chip, box))
        found.append(_shape(mirrored, box)[MIRROR_68] * [-1, 1] + [_CHIP_PX, 0])
    return crop.to_photo(np.mean(found, 0))


def _shape(chip: np.ndarray, box: Any) -> np.ndarray:
    parts = _predictor()(chip, box).parts()
    return np.array([(point.x, point.y) for point in parts], np.float64) + PIXEL_CENTRE


def _turn_back(points_px: np.ndarray, turns: int, shape: tuple[int, ...]) -> np.ndarray:
    """Convert points [N, 2] of np.rot90(image, turns) to pixels of the image with shape (height, width)."""
    height, width = shape[:2]
    x, y = points_px.T
    return np.stack([(x, y), (width - y, x), (width - x, height - y), (y, height - x)][turns], -1)


def _reduced(image: np.ndarray, scale: float) -> np.ndarray:
    """Resize to uint8 by averaging (or smoothly enlarging) without a float copy of the whole image."""
    block = max(1, min(int(1 / scale), *image.shape[:2]))  # an image may be one pixel wide
    size = [max(1, round(length * scale)) for length in image.shape[:2]]
    return np.round(resized(block_means(image, block), *size)).clip(0, 255).astype(np.uint8)


def _brightened(image: np.ndarray) -> np.ndarray:
    """A tone curve [256] that lifts shadows: the 99th percentile becomes white, then a gamma of 1/2."""
    white = max(float(np.percentile(image, 99)), 1.0)
    return np.round(255 * (np.arange(256) / white).clip(0, 1) ** 0.5).astype(np.uint8)


def face_descriptor(image_srgb: np.ndarray, landmarks_px: np.ndarray) -> np.ndarray:
    """The descriptor [128] of a face in an sRGB image [H, W, 3] in 0..1; landmarks [68, 2] in its pixels.

    King, *High quality face recognition with deep metric learning*, 2017: a ResNet of 29 layers on a
    150 px image that the landmarks align. Descriptors of one person are mostly less than 0.6 apart; compute
    both with the landmarks of the ground truth, on images with the same mask (paper, 'Results': Face dis).
    """
    if landmarks_px.shape != (68, 2) or image_srgb.ndim != 3 or image_srgb.shape[2] != 3:
        raise ValueError(
            f"image {image_srgb.shape}, landmarks {landmarks_px.shape}: give [H, W, 3] and [68, 2]"
        )
    image = np.round(np.clip(image_srgb, 0, 1) * 255).astype(np.uint8)
    points = [_dlib().point(*map(round, point)) for point in (landmarks_px - PIXEL_CENTRE).tolist()]
    (left, top), (right, bottom) = landmarks_px.min(0).tolist(), landmarks_px.max(0).tolist()
    box = _dlib().rectangle(round(left), round(top), round(right), round(bottom))
    shape = _dlib().full_object_detection(box, points)
    return np.array(_recognition().compute_face_descriptor(np.ascontiguousarray(image), shape))


@cache
def _dlib() -> Any:
    """The library; raises FacerfError where it is not installed."""
    if find_spec("dlib") is None:
        raise FacerfError("dlib is missing; install it with: pip install 'facerf[dlib]'")
    return importlib.import_module("dlib")


@cache
def _detector() -> Any:
    return _dlib().get_frontal_face_detector()


@cache
def _predictor() -> Any:
    return _dlib().shape_predictor(str(predictor_path()))


@cache
def _recognition() -> Any:
    return _dlib().face_recognition_model_v1(str(_bundled_model(_RECOGNITION_FILE)))


def predictor_path() -> Path:
    """Path of dlib's model of the 68 landmarks."""
    return _bundled_model(_PREDICTOR_FILE)


def _bundled_model(name: str) -> Path:
    """Path of a file in `face_recognition_models`, without importing it: the import needs pkg_resources.

    Raises FacerfError where the file is missing.
    """
    spec = find_spec(_MODELS_PACKAGE)
    path = Path(spec.origin).parent / "models" / name if spec and spec.origin else None
    if path is None or not path.is_file():
        raise FacerfError(f"{name}: the model is missing; install it with: pip install 'facerf[dlib]'")
    return path
