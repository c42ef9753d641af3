"""A camera's frames, small, read once for all checks; and what is measured at full size on the way.

Held are a grey picture of at most `side_px` a light and some figures; full pictures pass one at a time.
"""

import hashlib
from dataclasses import dataclass

import numpy as np
import torch
import torch.nn.functional as F

from facerf_cli.errors import InputError
from facerf_cli.face.joint_fit import PosedCamera
from facerf_cli.files.images import read_image
from facerf_cli.stage.data.capture import Capture

_FACE_PX = 512  # the longer side of the picture that the face is found on
_BRIGHT = 0.2  # of the brightest blocks
_AT_THE_TOP = 1 - 1e-5  # of a frame's maximum: what a clipped value may lose in arithmetic


@dataclass(frozen=True)
class FrameFigures:
    """What is measured on a frame at its full size, as recorded (times the lamp's intensity)."""

    digest: str  # of the pixels
    highest: float  # of all values
    share_highest: float  # of the pixels that have the highest value in some channel
    spread: float  # highest less lowest
    comb: float  # how odd and even rows differ, over what they have in common
    comb_ratio: float  # over how odd and even columns differ


@dataclass(frozen=True, eq=False)
class CameraFrames:
    """The frames of a subject in a camera that could be read: `places` in the capture's lights, ascending."""

    subject: str
    camera: str
    light_ids: tuple[str, ...]  # of the frames
    places: np.ndarray  # [L] in the capture's lights
    directions: np.ndarray  # [L, 3] unit, toward the lights, camera space
    grey: np.ndarray  # [L, h, w] float32 linear, under a light of rgb 1
    figures: tuple[FrameFigures, ...]
    scale: float  # pixels of the camera to one of `grey`
    lit: np.ndarray  # [H, W] float32: the mean of all frames, larger, to find the face on
    lit_scale: float  # pixels of the camera to one of `lit`

    def less(self, broken: set[str]) -> "CameraFrames":
        """Without the frames under these lights."""
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
    """A frame that could not be read: its light, why, and whether only its size is wrong."""

    light: str
    reason: str
    wrong_size: bool


def read_frames(
    capture: Capture, subject: str, camera: str, side_px: int
) -> tuple[CameraFrames, list[Unread]]:
    """Read a camera's frames that exist; those that cannot be read are told apart."""
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
    """Height and width of a camera's picture made to fit `side_px`, never larger, and its pixels to one."""
    scale = max(posed.width_px, posed.height_px, side_px) / side_px
    return (max(round(posed.height_px / scale), 1), max(round(posed.width_px / scale), 1)), scale


def _decodes(capture: Capture, subject: str, camera: str, light: str) -> bool:
    try:
        read_image(capture.frame_path(subject, camera, light), capture.colour_space, non_finite="zero")
    except InputError:
        return False
    return True


def grey_of(pixels: np.ndarray) -> np.ndarray:
    """The mean of the channels [H, W]; numpy's own is many times slower over an axis of three."""
    return (pixels[..., 0] + pixels[..., 1] + pixels[..., 2]) / np.float32(3)


def small(grey: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """A plane made small, each pixel the mean of its area."""
    return F.interpolate(torch.from_numpy(grey)[None, None], size, mode="area")[0, 0].numpy()


def _measure(pixels: np.ndarray) -> FrameFigures:
    """Figures of a full picture [H, W, 3]."""
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
    """How much odd rows of a picture [H, W] differ from even ones, over their mean, median of bright blocks.

    A row's departure from the mean of its neighbours, its sign turned every other row, adds up over a block
    of 8 x 4 pixels only if rows alternate. Blocks are small, for pictures scaled or turned after they were
    taken alternate in step for a few rows only.
    """
    departure = grey[1:-1] - (grey[:-2] + grey[2:]) / 2
    departure = departure * np.where(np.arange(len(departure)) % 2, -1, 1)[:, None]
    if len(departure) < 8 or departure.shape[1] < 4:
        return 0.0
    mean = _blocks(grey[1:-1])
    bright = mean > max(_BRIGHT * float(np.percentile(mean, 95)), 0)
    return float(np.median(np.abs(_blocks(departure))[bright] / mean[bright])) if bright.any() else 0.0


def _blocks(plane: np.ndarray) -> np.ndarray:
    """Means of whole blocks of 8 x 4 pixels."""
    height, width = plane.shape[0] // 8, plane.shape[1] // 4
    return plane[: height * 8, : width * 4].reshape(height, 8, width, 4).mean((1, 3))
