"""Frames of a camera as the checks see them: small grey images, and measurements of the full frames.

Each frame is read once for all checks, and one full frame is in memory at a time.
"""

import hashlib
from dataclasses import dataclass

import numpy as np
import torch
import torch.nn.functional as F

from facerf_cli.capture.capture import Capture
from facerf_cli.errors import InputError
from facerf_cli.face.joint_fit import PosedCamera
from facerf_cli.files.images import read_image

_FACE_PX = 512  # longest side of the image in which the face is detected
_BRIGHT = 0.2  # of the brightest blocks: darker ones do not count in `comb`
_AT_THE_TOP = 1 - 1e-5  # of a frame's maximum: arithmetic may move clipped values this far apart


@dataclass(frozen=True)
class FrameFigures:
    """Measurements of a full-size frame with recorded values, not divided by the light's intensity."""

    digest: str  # SHA-256 of the pixels
    highest: float  # largest value
    share_highest: float  # of the pixels with the largest value in some channel
    spread: float  # largest less smallest value
    comb: float  # relative difference between odd and even rows, see `comb`
    comb_ratio: float  # that over the difference between odd and even columns


@dataclass(frozen=True, eq=False)
class CameraFrames:
    """The readable frames of a subject in a camera, small and grey."""

    subject: str
    camera: str
    light_ids: tuple[str, ...]  # of the frames
    places: np.ndarray  # [L] indices into the capture's lights, ascending
    directions: np.ndarray  # [L, 3] unit, toward the lights, camera space
    grey: np.ndarray  # [L, h, w] float32 linear, under a light of rgb 1
    figures: tuple[FrameFigures, ...]
    scale: float  # pixels of the camera per pixel of `grey`
    lit: np.ndarray  # [H, W] float32: mean of all frames, larger, to detect the face in
    lit_scale: float  # pixels of the camera per pixel of `lit`

    def without(self, broken: set[str]) -> "CameraFrames":
        """Remove the frames under these lights."""
        kept = [row for row, light in enumerate(self.light_ids) if light not in broken]
        return CameraFrames(
            subject=self.subject,
            camera=self.camera,
            light_ids=tuple(self.light_ids[row] for row in kept),
            places=self.places[kept],
            directions=self.directions[kept],
            grey=self.grey[kept],
            figures=tuple(self.figures[row] for row in kept),
            scale=self.scale,
            lit=self.lit,
            lit_scale=self.lit_scale,
        )


@dataclass(frozen=True)
class Unread:
    """A frame that could not be read."""

    light: str
    reason: str
    wrong_size: bool  # the file is sound, but not of the camera's size


def read_frames(
    capture: Capture, subject: str, camera: str, side_px: int
) -> tuple[CameraFrames, list[Unread]]:
    """Read the frames of a camera that exist, shrunk to `side_px`; return unreadable ones separately."""
    posed = capture.cameras[camera]
    size, scale = _fitted(posed, side_px)
    lit_size, lit_scale = _fitted(posed, _FACE_PX)
    lit = np.zeros(lit_size, np.float32)
    places, greys, figures, unread = [], [], [], []
    for place, light in enumerate(capture.light_ids):
        if not capture.frame_path(subject, camera, light).exists():
            continue
        try:
            pixels = capture.frame(subject, camera, place)
        except InputError as error:
            unread.append(Unread(light, str(error), _decodes(capture, subject, camera, light)))
            continue
        places.append(place)
        figures.append(_measure(pixels * capture.intensities[place].astype(np.float32)))
        grey = grey_of(pixels)
        greys.append(small(grey, size))
        lit += small(grey, lit_size)
    rows = np.array(places, int)
    frames = CameraFrames(
        subject=subject,
        camera=camera,
        light_ids=tuple(capture.light_ids[place] for place in places),
        places=rows,
        directions=capture.directions_world[rows] @ posed.rotation.double().numpy().T,
        grey=np.stack(greys) if greys else np.zeros((0, *size), np.float32),
        figures=tuple(figures),
        scale=scale,
        lit=lit / max(len(places), 1),
        lit_scale=lit_scale,
    )
    return frames, unread


def _fitted(posed: PosedCamera, side_px: int) -> tuple[tuple[int, int], float]:
    """Height and width of a camera's image shrunk to `side_px`, and the camera's pixels per pixel of it."""
    scale = max(posed.width_px, posed.height_px, side_px) / side_px
    return (max(round(posed.height_px / scale), 1), max(round(posed.width_px / scale), 1)), scale


def _decodes(capture: Capture, subject: str, camera: str, light: str) -> bool:
    try:
        read_image(capture.frame_path(subject, camera, light), capture.colour_space, non_finite="zero")
    except InputError:
        return False
    return True


def grey_of(pixels: np.ndarray) -> np.ndarray:
    """Mean of the channels [H, W]; numpy's mean is many times slower over an axis of three."""
    return (pixels[..., 0] + pixels[..., 1] + pixels[..., 2]) / np.float32(3)


def small(grey: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """Shrink a plane [H, W] by area averaging."""
    return F.interpolate(torch.from_numpy(grey)[None, None], size, mode="area")[0, 0].numpy()


def _measure(pixels: np.ndarray) -> FrameFigures:
    """Measure a frame [H, W, 3] at full size."""
    highest, grey = float(pixels.max()), grey_of(pixels)
    rows, columns = comb(grey), comb(grey.T)
    top = (pixels >= highest * _AT_THE_TOP).any(-1) if highest > 0 else np.zeros(1)
    return FrameFigures(
        digest=hashlib.sha256(pixels.tobytes()).hexdigest(),
        highest=highest,
        share_highest=float(top.mean()),
        spread=highest - float(pixels.min()),
        comb=rows,
        comb_ratio=rows / max(columns, 1e-6),
    )


def comb(grey: np.ndarray) -> float:
    """Relative difference between odd and even rows of an image [H, W], as the median of bright blocks.

    A row's deviation from the mean of its neighbours, with alternating sign, adds up over a block of 8 x 4
    pixels only if rows alternate. Blocks are small because rows of a resampled image alternate in phase only
    locally.
    """
    departure = grey[1:-1] - (grey[:-2] + grey[2:]) / 2
    departure = departure * np.where(np.arange(len(departure)) % 2, -1, 1)[:, None]
    if len(departure) < 8 or departure.shape[1] < 4:
        return 0.0
    mean = _blocks(grey[1:-1])
    bright = mean > max(_BRIGHT * float(np.percentile(mean, 95)), 0)
    return float(np.median(np.abs(_blocks(departure))[bright] / mean[bright])) if bright.any() else 0.0


def _blocks(plane: np.ndarray) -> np.ndarray:
    """Means of the complete blocks of 8 x 4 pixels."""
    height, width = plane.shape[0] // 8, plane.shape[1] // 4
    return plane[: height * 8, : width * 4].reshape(height, 8, width, 4).mean((1, 3))
