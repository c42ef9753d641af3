"""The photo of a page and, smaller, the part of it that holds the person: two frames of one head."""

from dataclasses import dataclass, replace

import numpy as np

from facerf_cli.composite import Composition, Target
from facerf_cli.face.head import Head
from facerf_cli.models import Models
from facerf_cli.pipeline import composition_of
from facerf_cli.portrait_field import PortraitField
from facerf_cli.resize import fitted, moved_crop, moved_head, resized

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
    person = replace(field.person, square=moved_crop(field.person.square, box.left, box.top, scale))
    target = Target(matte=resized(box.of(matte), height, width), background="none")
    return composition_of(
        models,
        resized(box.of(photo), height, width),
        moved_head(head, box.left, box.top, scale),
        replace(field, person=person),
        target,
    )
