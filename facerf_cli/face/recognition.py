"""Identity of a face: the descriptor of dlib's face-recognition network (paper, 'Results': Face dis)."""

from functools import cache
from typing import Any

import dlib
import numpy as np

from facerf_cli.face.dlib_landmarks import bundled_model
from facerf_cli.raster.camera import PIXEL_CENTRE

RECOGNITION_LICENCE = (
    "dlib_face_recognition_resnet_model_v1: in the public domain (Davis King); trained on FaceScrub, VGG "
    "Face, the web"
)
_NETWORK_FILE = "dlib_face_recognition_resnet_model_v1.dat"


def face_descriptor(image_srgb: np.ndarray, landmarks_px: np.ndarray) -> np.ndarray:
    """The descriptor [128] of a face in an sRGB image [H, W, 3] in 0..1; landmarks [68, 2] in its pixels.

    King, *High quality face recognition with deep metric learning*, 2017: a ResNet of 29 layers on a
    150 px image that the landmarks align. Descriptors of one person are mostly less than 0.6 apart.
    """
    if landmarks_px.shape != (68, 2) or image_srgb.ndim != 3 or image_srgb.shape[2] != 3:
        raise ValueError(
            f"image {image_srgb.shape}, landmarks {landmarks_px.shape}: give [H, W, 3] and [68, 2]"
        )
    image = np.round(np.clip(image_srgb, 0, 1) * 255).astype(np.uint8)
    points = [dlib.point(*map(round, point)) for point in (landmarks_px - PIXEL_CENTRE).tolist()]
    (left, top), (right, bottom) = landmarks_px.min(0).tolist(), landmarks_px.max(0).tolist()
    box = dlib.rectangle(round(left), round(top), round(right), round(bottom))
    shape = dlib.full_object_detection(box, points)
    return np.array(_network().compute_face_descriptor(np.ascontiguousarray(image), shape))


def descriptor_distance(first: np.ndarray, second: np.ndarray) -> float:
    """The Euclidean distance of two descriptors [128] ('Face dis').

    Compute both with the landmarks of the ground truth, on images with the same mask, so that differences in
    detection do not count.
    """
    return float(np.linalg.norm(first - second))


@cache
def _network() -> Any:
    return dlib.face_recognition_model_v1(str(bundled_model(_NETWORK_FILE)))
