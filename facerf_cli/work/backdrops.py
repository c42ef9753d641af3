"""Backgrounds of relit photos: images [H, W, 3] behind a person, for each light setup."""

from functools import partial

import numpy as np
import torch
import torch.nn.functional as F

from facerf_cli.cli.backgrounds import BackgroundChoice
from facerf_cli.cli.lights import LightSetup
from facerf_cli.files.images import read_image
from facerf_cli.image.strips import Band
from facerf_cli.light.backdrop import backdrop
from facerf_cli.raster.camera import Camera, rays_of_rows
from facerf_cli.run import memory
from facerf_cli.work.light_weights import read_map

_HELD_BYTES = 24  # of a pixel of the photo: it, its matte and the view of its face
_COVER_BYTES = 12  # of a pixel of the frame, which an image covers


class Backdrops:
    """Draws the chosen background for a photo's camera; what setups share is drawn once."""

    def __init__(self, choice: BackgroundChoice, blur: float, camera: Camera) -> None:
        self._choice, self._blur, self._camera = choice, blur, camera
        self._fixed = _fixed(choice, camera)

    def behind(self, setup: LightSetup, ev: float) -> Band | None:
        """The image behind a person under a setup, scene-linear; None for the photo's own, or for nothing.

        A file and a colour look as they are at an exposure of `ev`. A map is as bright as its light; single
        lights have a black surrounding.
        """
        fixed, gain = self._fixed, np.float32(2.0**-ev)
        if self._choice.kind != "envmap":
            return None if fixed is None else lambda rows: fixed[rows] * gain
        if setup.envmap is None:
            width_px = self._camera.width_px
            return lambda rows: np.zeros((rows.stop - rows.start, width_px, 3), np.float32)
        with memory.beside(_held_bytes(self._camera)):
            envmap = read_map(setup.envmap)
        size = self._camera.height_px, self._camera.width_px
        return backdrop(envmap, size, partial(rays_of_rows, self._camera), setup.rotate_deg, self._blur)


def _held_bytes(camera: Camera) -> int:
    """Memory of the photo that is held while a background is read."""
    return _HELD_BYTES * camera.height_px * camera.width_px


def _fixed(choice: BackgroundChoice, camera: Camera) -> np.ndarray | None:
    height, width = camera.height_px, camera.width_px
    if choice.colour is not None:
        return np.broadcast_to(np.array(choice.colour, np.float32), (height, width, 3))
    if choice.path is None:
        return None
    with memory.beside(_held_bytes(camera) + _COVER_BYTES * height * width):
        return _covering(read_image(choice.path, None).pixels, height, width)


def _covering(image: np.ndarray, height: int, width: int) -> np.ndarray:
    """The middle of an image, scaled to cover a frame."""
    scale = max(height / image.shape[0], width / image.shape[1])
    rows, columns = (
        min(side, round(wanted / scale)) for side, wanted in zip(image.shape, (height, width), strict=False)
    )
    top, left = (image.shape[0] - rows) // 2, (image.shape[1] - columns) // 2
    part = torch.from_numpy(image[top : top + rows, left : left + columns]).permute(2, 0, 1)[None]
    shrinks = scale < 1
    sized = F.interpolate(part, (height, width), mode="bilinear", align_corners=False, antialias=shrinks)
    covered: np.ndarray = sized[0].permute(1, 2, 0).numpy()
    return covered
