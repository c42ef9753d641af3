"""The photo of a page and, smaller, the part of it that holds the person: two frames of one head."""

from dataclasses import dataclass, replace

import numpy as np
import torch
import torch.nn.functional as F

from facerf_cli.composite import Composition, Target
from facerf_cli.face.crop import Crop
from facerf_cli.face.head import Head
from facerf_cli.models import Models
from facerf_cli.pipeline import composition_of
from facerf_cli.portrait_field import PortraitField

_SEEN = 0.02  # share of the person from which on a pixel is inside the box


@dataclass(frozen=True)
class PersonBox:
    """A part of a frame, in its pixels."""

    left: int
    top: int
    width: int
    height: int

    @staticmethod
    def around(matte: np.ndarray) -> "PersonBox":
        """The smallest box with all of a person's matte [H, W]; the whole frame of an empty matte."""
        rows, columns = (np.flatnonzero((matte > _SEEN).any(axis)) for axis in (1, 0))
        if not len(rows):
            return PersonBox(0, 0, matte.shape[1], matte.shape[0])
        left, top = int(columns[0]), int(rows[0])
        return PersonBox(left, top, int(columns[-1]) + 1 - left, int(rows[-1]) + 1 - top)

    def of(self, image: np.ndarray) -> np.ndarray:
        """The part [height, width, ...] of an image."""
        return image[self.top : self.top + self.height, self.left : self.left + self.width]


def resized(image: np.ndarray, height: int, width: int) -> np.ndarray:
    """An image [H, W, C] or [H, W] at another size, smoothed where it becomes smaller."""
    planes = torch.from_numpy(np.ascontiguousarray(image, np.float32))
    planes = planes[None] if planes.ndim == 2 else planes.permute(2, 0, 1)
    sized = F.interpolate(planes[None], (height, width), mode="bilinear", align_corners=False, antialias=True)
    plain = sized[0].permute(1, 2, 0).numpy()
    return np.ascontiguousarray(plain[..., 0] if image.ndim == 2 else plain)


def fitted(height: int, width: int, most_px: int) -> tuple[int, int]:
    """The size of a frame whose longer side is `most_px` at most."""
    scale = min(1.0, most_px / max(height, width))
    return max(1, round(height * scale)), max(1, round(width * scale))


def shrunk_photo(photo: np.ndarray, head: Head, most_px: int) -> tuple[np.ndarray, Head]:
    """A photo [H, W, 3] of `most_px` at most, and its head in the pixels of the smaller one."""
    height, width = fitted(photo.shape[0], photo.shape[1], most_px)
    if (height, width) == photo.shape[:2]:
        return photo, head
    whole = PersonBox(0, 0, photo.shape[1], photo.shape[0])
    return resized(photo, height, width), _moved_head(head, whole, width / photo.shape[1])


def small_composition(
    models: Models,
    photo: np.ndarray,
    head: Head,
    field: PortraitField,
    matte: np.ndarray,
    box: PersonBox,
    px: int,
) -> Composition:
    """Compose the person in a box of the photo, at `px` pixels along its longer side at most."""
    height, width = fitted(box.height, box.width, px)
    scale = width / box.width
    person = replace(field.person, square=_moved(field.person.square, box, scale))
    target = Target(matte=resized(box.of(matte), height, width), background="none")
    return composition_of(
        models,
        resized(box.of(photo), height, width),
        _moved_head(head, box, scale),
        replace(field, person=person),
        target,
    )


def _moved_head(head: Head, box: PersonBox, scale: float) -> Head:
    return replace(head, fit=replace(head.fit, crop=_moved(head.fit.crop, box, scale)))


def _moved(crop: Crop, box: PersonBox, scale: float) -> Crop:
    """A crop of a photo, in the pixels of a box that is scaled."""
    x0_px, y0_px = (crop.x0_px - box.left) * scale, (crop.y0_px - box.top) * scale
    return replace(crop, x0_px=x0_px, y0_px=y0_px, side_px=crop.side_px * scale)
