"""Frames of a video; of a photo, those of a camera that pans and zooms by less than a pixel a frame."""

from itertools import islice
from pathlib import Path

import numpy as np
from skimage.transform import SimilarityTransform, warp

from facerf_cli.batch.inputs import VIDEO_SUFFIXES
from facerf_cli.files.read import read_image
from facerf_cli.image.colour import linear_to_srgb, srgb_to_linear
from facerf_cli.image.strips import fitted, resized

SIDE_PX = 512  # of the longer side of a photo
NOISE = 0.006  # standard deviation, display values: 1.5 of 255
SEED = 101


def frames_of(path: Path, count: int) -> list[np.ndarray]:
    """At most `count` scene-linear frames [H, W, 3]."""
    if path.suffix.lower() in VIDEO_SUFFIXES:
        from facerf_cli.files.video import Video

        coded = islice(Video(path).frames(), count)
        return [np.asarray(srgb_to_linear(x[..., :3] / np.iinfo(x.dtype).max), np.float32) for x in coded]
    photo = read_image(path).pixels
    photo = resized(photo, *fitted(*photo.shape[:2], SIDE_PX)) if max(photo.shape[:2]) > SIDE_PX else photo
    return panned(np.asarray(linear_to_srgb(photo.clip(0, 1))), count)


def panned(photo: np.ndarray, count: int) -> list[np.ndarray]:
    """Scene-linear frames of a photo [H, W, 3] in display values, with noise, in 8 bits."""
    random = np.random.default_rng(SEED)
    frames = []
    for n in range(count):
        seen = warp(photo, camera_at(n, photo.shape), order=3, mode="reflect")
        noisy = (seen + random.normal(0, NOISE, seen.shape)).clip(0, 1)
        frames.append(np.asarray(srgb_to_linear(np.round(255 * noisy) / 255), np.float32))
    return frames


def camera_at(frame: int, shape: tuple[int, ...]) -> SimilarityTransform:
    """Places in the photo of a frame's pixels: in each frame 0.6 px to the right, 0.35 down, 0.1 % nearer."""
    middle = np.array([shape[1] - 1, shape[0] - 1]) / 2
    scale = 1.001**-frame
    shift = np.array([0.6, 0.35]) * frame
    return SimilarityTransform(scale=scale, translation=shift + middle * (1 - scale))
