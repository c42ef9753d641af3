"""Face-recognition descriptor from dlib (an extra), for the paper's Face dis and for `--identity`."""

import importlib
from collections.abc import Callable
from functools import cache
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

from facerf_cli.errors import FacerfError
from facerf_cli.image.colour import display_ev, linear_to_srgb
from facerf_cli.raster.camera import PIXEL_CENTRE

LICENCE = (
    "dlib_face_recognition_resnet_model_v1: in the public domain (Davis King); trained on FaceScrub, VGG "
    "Face, the web"
)
_MODELS_PACKAGE = "face_recognition_models"
_FILE = "dlib_face_recognition_resnet_model_v1.dat"


def face_descriptor(image_srgb: np.ndarray, landmarks_px: np.ndarray) -> np.ndarray:
    """Compute the descriptor [128] of a face in an sRGB image [H, W, 3] in 0..1, from its landmarks [68, 2].

    King, *High quality face recognition with deep metric learning*, 2017: a ResNet of 29 layers on a 150 px
    image aligned by the landmarks. The distance between descriptors of one person is usually below 0.6.
    Compute both with the landmarks of the ground truth, on images with the same mask (paper, 'Results').
    """
    if landmarks_px.shape != (68, 2) or image_srgb.ndim != 3 or image_srgb.shape[2] != 3:
        raise ValueError(f"image {image_srgb.shape}, landmarks {landmarks_px.shape}")
    dlib, recognition = _recognition()
    image = np.round(np.clip(image_srgb, 0, 1) * 255).astype(np.uint8)
    # dlib's pixel centres are integers
    points = [dlib.point(*map(round, point)) for point in (landmarks_px - PIXEL_CENTRE).tolist()]
    (left, top), (right, bottom) = landmarks_px.min(0).tolist(), landmarks_px.max(0).tolist()
    box = dlib.rectangle(round(left), round(top), round(right), round(bottom))
    shape = dlib.full_object_detection(box, points)
    return np.array(recognition.compute_face_descriptor(np.ascontiguousarray(image), shape))


def distances_from(photo: np.ndarray, landmarks_px: np.ndarray) -> Callable[[np.ndarray], float]:
    """Return a function that measures the distance of an exposed image of a face from its photo [H, W, 3]."""

    def descriptor(pixels: np.ndarray) -> np.ndarray:
        return face_descriptor(linear_to_srgb(pixels.clip(0, 1)), landmarks_px)

    of_photo = descriptor(photo * np.float32(2.0 ** display_ev(photo)))
    return lambda pixels: round(float(np.linalg.norm(descriptor(pixels) - of_photo)), 3)


@cache  # a network of 20 MB
def _recognition() -> tuple[Any, Any]:
    """Load the library and its network; raises FacerfError if it is not installed."""
    path = descriptor_path()
    if find_spec("dlib") is None:
        raise FacerfError("dlib is missing; install it with: pip install 'facerf[dlib]'")
    dlib = importlib.import_module("dlib")
    return dlib, dlib.face_recognition_model_v1(str(path))


def descriptor_path() -> Path:
    """Locate the network in `face_recognition_models` without importing it; the import needs pkg_resources.

    Raises FacerfError if the file is missing.
    """
    spec = find_spec(_MODELS_PACKAGE)
    path = Path(spec.origin).parent / "models" / _FILE if spec and spec.origin else None
    if path is None or not path.is_file():
        raise FacerfError(f"{_FILE} is missing; install it with: pip install 'facerf[dlib]'")
    return path
