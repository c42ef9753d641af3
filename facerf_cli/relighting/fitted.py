"""A fitted person, and the subjects that are composed of it: images that differ by their light alone."""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import numpy as np
import torch
from torch import Tensor

from facerf_cli.baselines.base import Reflectance
from facerf_cli.face.fit import FaceFit
from facerf_cli.face.head import FaceTexture, Head
from facerf_cli.face.view import photo_camera
from facerf_cli.image.colour import to_display
from facerf_cli.light.light import Light
from facerf_cli.light.sphere import RigLight
from facerf_cli.portrait.segment import Segmentation, segment
from facerf_cli.raster.camera import Camera
from facerf_cli.relighting.face_alone import FaceAlone, FaceInPhoto
from facerf_cli.relighting.field import Field
from facerf_cli.relighting.models import Models
from facerf_cli.relighting.people_in_photo import Background, PeopleInPhoto
from facerf_cli.relighting.person_in_photo import PersonInPhoto
from facerf_cli.relighting.portrait_field import PortraitField
from facerf_cli.relighting.relightable import Relightable, RenderRequest
from facerf_cli.relighting.white import Balance

_LIGHTS_AT_ONCE, _PIXELS_AT_ONCE = 8, 1 << 23  # of OLAT images, at most


@dataclass(frozen=True, eq=False)
class Target:
    """The pose and the surroundings in which a relit head is shown.

    `fit` is the head's pose and shape as shown; None: as in the photo. `composite` is the photo with its
    person relit, or the rendered face alone. A `matte` [H, W] in 0..1 says what is relit, by default all;
    it is multiplied by the `alpha` [H, W] of the photo itself. Behind it stays the photo, or nothing, or
    what is given with each light.
    """

    fit: FaceFit | None = None
    composite: Literal["photo", "face"] = "photo"
    matte: np.ndarray | None = None
    alpha: np.ndarray | None = None
    background: Background = "photo"


AS_IN_PHOTO = Target()


@dataclass(frozen=True, eq=False)
class FittedPerson:
    """One person of a photo, with all that no light changes.

    Attributes:
        models: The networks and the face model.
        photo: Scene-linear [H, W, 3]; None: the face alone, in the frame of its crop.
        head: The fitted face model, and the face's texture.
        reflectance: The person under any lights.
        given_matte: Share [H, W] of the photo, if it was given.
    """

    models: Models
    photo: np.ndarray | None
    head: Head
    reflectance: Reflectance
    given_matte: np.ndarray | None = None

    @cached_property
    def segmentation(self) -> Segmentation:
        """Classes and matte of the person in the photo."""
        assert self.photo is not None
        if isinstance(self.reflectance, PortraitField):
            return self.reflectance.person.segmentation
        landmarks_px = self.head.fit.crop.to_photo(self.head.landmarks_px)
        people, matte, others = self.models.networks.people, self.given_matte, self.head.others
        return segment(people, to_display(self.photo), landmarks_px, matte, others)

    @property
    def share(self) -> np.ndarray:
        """The person's share [H, W] of the photo."""
        return self.segmentation.matte if self.given_matte is None else self.given_matte

    @property
    def field(self) -> Reflectance:
        """The reflectance of the face."""
        return self.reflectance.field if isinstance(self.reflectance, PortraitField) else self.reflectance

    @property
    def face(self) -> FaceTexture:
        """The face as it is relit: the photo's, or with another texture."""
        return self.field.face if isinstance(self.field, Field) else self.head.face

    @property
    def photo_camera(self) -> Camera:
        """The photo's camera."""
        assert self.photo is not None
        return photo_camera(self.head.fit.crop, self.photo.shape[0], self.photo.shape[1])

    @property
    def balance(self) -> Balance | None:
        """The balance of the person's white; the paper's baselines have none."""
        return self.field.balance if isinstance(self.field, Field) else None

    @property
    def even_brightness(self) -> float:
        """Brightness of even light, from all around, under which the skin is as bright as in the photo."""
        return 1.0 if self.balance is None else self.balance.even

    def composed(self, target: Target = AS_IN_PHOTO) -> Relightable:
        """Prepare images of the person in a pose, before a background, that differ by their light alone."""
        if self.photo is None or target.composite == "face":
            return self.face_alone(target.fit)
        return PeopleInPhoto([self.in_photo(target)], target.background)

    def face_alone(self, fit: FaceFit | None = None) -> FaceAlone:
        """Prepare the face alone, in the pose of a fit, by default that of the photo."""
        photo_px = None if self.photo is None else (self.photo.shape[0], self.photo.shape[1])
        return FaceAlone(self.models.face, self.head, self.reflectance, fit, photo_px)

    def in_photo(self, target: Target = AS_IN_PHOTO) -> PersonInPhoto | FaceInPhoto:
        """Prepare the person in its photo; the target's matte says which part of it changes."""
        assert self.photo is not None
        matte = self.share
        for part in (target.matte, target.alpha):
            matte = matte if part is None else (matte * part).astype(np.float32, copy=False)
        if isinstance(self.reflectance, PortraitField):
            return PersonInPhoto(self.models.face, self.photo, self.head, self.reflectance, matte)
        return FaceInPhoto(self.face_alone(), self.photo, matte)

    def image(self, light: RigLight, target: Target = AS_IN_PHOTO) -> np.ndarray:
        """The person [H, W, 3] under one light (paper, 'Relighting'), not multiplied by alpha."""
        subject = self.composed(target)
        return subject.image(next(subject.relit(Light(light.directions, light.weights[None]))))


def olat_images(subject: Relightable, directions: Tensor) -> Iterator[np.ndarray]:
    """Yield images [l, H, W, 3] of a subject over black under each of the lights [L, 3] alone."""
    height, width = subject.size_px
    at_once = max(1, min(_LIGHTS_AT_ONCE, _PIXELS_AT_ONCE // (height * width)))
    return (_under_each(subject, some) for some in torch.split(directions, at_once))


def _under_each(subject: Relightable, directions: Tensor) -> np.ndarray:
    images = np.empty((len(directions), *subject.size_px, 3), np.float32)
    lights = {str(number): one for number, one in enumerate(subject.relit(Light.each(directions)))}
    subject.rendered(RenderRequest(lights=lights), lambda number, shape: images[int(number)])
    return images
