"""Basis images of an OLAT stack: an image under any light is a guide times a weighted sum of ratio images.

The guide is the mean image of all lights at the photo's size. A ratio image, a light's image divided by the
mean, is smooth and therefore small. Both are 8-bit: the guide in sRGB, a ratio as its square root.
"""

import math
from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np
import torch
from scipy.ndimage import distance_transform_edt
from torch import Tensor

from facerf_cli.face.head import shrunk_photo
from facerf_cli.image.colour import (
    AUTO_EXPOSURE_PERCENTILE,
    linear_to_srgb,
    luminance,
    srgb_to_linear,
)
from facerf_cli.image.strips import fitted, resized
from facerf_cli.light.light import Light
from facerf_cli.light.sphere import rig_directions
from facerf_cli.person import Person
from facerf_cli.portrait.parse import class_index
from facerf_cli.relighting.people_in_photo import PeopleInPhoto
from facerf_cli.relighting.portrait_field import PersonShading, PortraitField, PortraitView
from facerf_cli.relighting.relightable import Relit

RATIO_PX = 320  # longer side of a ratio image
MOST_LIGHTS = 400  # from larger stacks, this many evenly spread lights are used
_LIGHTS_AT_ONCE = 10
_DARK = 5e-3  # of the guide's mean over the person, added to the guide to avoid division by 0
_PERSON = 0.02  # least matte of a pixel with a ratio
_SURE = 0.5  # least matte or class probability of pixels for the exposure
_SAMPLES = 5000  # most pixels of the person from which a page chooses its exposure
_WHITE_PERCENTILE = 99.9  # of a guide or ratio: its 8-bit white


@dataclass(frozen=True, eq=False)
class Brightest:
    """Pixels that are among the brightest of a region's `total` pixels under some light.

    `luminances` [L, N] are under white lights; `shares` [N, 3] are the fractions of each primary in them.
    """

    luminances: np.ndarray
    shares: np.ndarray
    total: float

    @staticmethod
    def of(images: np.ndarray, mask: np.ndarray, percentile: float) -> "Brightest":
        """Select the pixels of a mask [...] in images [L, ..., 3] that decide their luminance percentile."""
        values = np.stack([luminance(image[mask].astype(np.float32)) for image in images])
        if not mask.any():
            return Brightest(values, np.zeros((0, 3), np.float32), 0.0)
        least = np.percentile(values, percentile, axis=1, method="lower", keepdims=True)
        places = np.flatnonzero(((values >= least) & (values > 0)).any(0))
        step = max(1, math.ceil(len(places) / _SAMPLES))
        places = places[::step]
        primaries = images.mean(0, dtype=np.float32)[mask][places] * luminance(np.eye(3, dtype=np.float32))
        shares = primaries / primaries.sum(1, keepdims=True)
        return Brightest(values[:, places], shares, int(mask.sum()) / step)


@dataclass(frozen=True, eq=False)
class LightSamples:
    """Pixels that a page uses to choose the exposure like `relight`.

    `face` [L, 3] is the face's mean luminance under each light, by the light's primaries. `plate` is the mean
    luminance of the face in the photo, which the exposure keeps, and the percentile of the person there.
    """

    person: Brightest
    face: np.ndarray | None = None
    plate: tuple[float, float] | None = None

    @staticmethod
    def of(
        images: np.ndarray,
        person: np.ndarray,
        face: np.ndarray | None = None,
        photo: np.ndarray | None = None,
    ) -> "LightSamples":
        """Sample images [L, h, w, 3] by mattes [h, w] of a person and its face, and the photo [h, w, 3]."""
        body = Brightest.of(images, person > _SURE, AUTO_EXPOSURE_PERCENTILE)
        if face is None or photo is None or not (face > _SURE).any():
            return LightSamples(body)
        plate = luminance(photo)
        bright = (
            float(plate[face > _SURE].mean()),
            float(np.percentile(plate[person > _SURE], AUTO_EXPOSURE_PERCENTILE)),
        )
        means = np.stack([image[face > _SURE].mean(0, dtype=np.float32) for image in images])
        return LightSamples(body, means * luminance(np.eye(3, dtype=np.float32)), bright)


@dataclass(frozen=True, eq=False)
class Basis:
    """A person over black under lights [L, 3], as 8-bit ratios [L, h, w, 3] to a guide [H, W, 3].

    An additional last ratio is under uniform light. The linear guide is the decoded sRGB times `white`; a
    linear ratio is (byte / 255)^2 times `scales` [L].
    """

    directions: np.ndarray
    ratios: np.ndarray
    scales: np.ndarray
    guide: np.ndarray
    white: float
    samples: LightSamples

    @staticmethod
    def of(
        directions: np.ndarray, images: np.ndarray, mean: np.ndarray, matte: np.ndarray, samples: LightSamples
    ) -> "Basis":
        """Encode small images [L, h, w, 3], their mean [H, W, 3] and the matte [H, W]."""
        dark = np.float32(_DARK * mean.sum() / max(3 * float(matte.sum()), 1.0))
        guide = np.maximum(mean, 0) + dark * matte[..., None]
        white = max(float(np.percentile(guide, _WHITE_PERCENTILE)), 1e-9)
        encoded = np.round(255 * linear_to_srgb((guide / white).clip(0, 1))).astype(np.uint8)
        size = images.shape[1:3]
        share = resized(matte, *size)
        small = images[: len(directions)].mean(0, dtype=np.float32).clip(0) + dark * share[..., None]
        below = np.clip(small, dark * share.clip(_PERSON)[..., None], white)
        outside = share < _PERSON
        nearest = tuple(distance_transform_edt(outside, return_distances=False, return_indices=True))
        ratios, scales = np.empty(images.shape, np.uint8), np.empty(len(images), np.float32)
        for light, image in enumerate(images):
            ratio = (np.maximum(image.astype(np.float32), 0) / below)[nearest]
            scales[light] = max(float(np.percentile(ratio, _WHITE_PERCENTILE)), 1e-9)
            ratios[light] = np.round(255 * np.sqrt((ratio / scales[light]).clip(0, 1)))
        return Basis(directions, ratios, scales, encoded, white, samples)

    def image(self, toward: np.ndarray) -> np.ndarray:
        """Return the small image [h, w, 3] over black under the light nearest to a direction [3]."""
        light = int((self.directions @ toward).argmax())
        ratio = (self.ratios[light].astype(np.float32) / 255) ** 2 * self.scales[light]
        return np.asarray(resized(_linear(self.guide, self.white), *ratio.shape[:2]) * ratio)


def _linear(encoded: np.ndarray, white: float) -> np.ndarray:
    return np.asarray(srgb_to_linear(encoded.astype(np.float32) / 255) * np.float32(white))


def basis_of_photo(person: Person, people: PeopleInPhoto) -> Basis:
    """Render the basis of a person, the only one of `people`, under the lights that `relight` uses for maps.

    The images of single lights, and of their mean as the last one, are rendered small; the mean is also
    rendered at the photo's size.
    """
    photo, field = person.photo, person.reflectance
    assert photo is not None and isinstance(field, PortraitField)
    small_photo, small_head = shrunk_photo(photo, person.head, RATIO_PX)
    small_field = _shrunk(field, photo, small_photo.shape[1], small_photo.shape[0])
    small = PeopleInPhoto([Person(person.models, small_photo, small_head, small_field).in_photo()])
    rig, view = rig_directions(), field.views[0]
    images: list[np.ndarray] = []
    coarse: list[np.ndarray] = []

    def add(relit: Relit) -> None:
        images.append(small.light_layer([relit]).astype(np.float16))
        (part,) = view.render(relit.views[0])
        coarse.append(part.permute(1, 2, 0).numpy().astype(np.float16))

    total: list[Tensor] = []
    for some in torch.split(rig, _LIGHTS_AT_ONCE):
        for (relit,) in people.relit(Light.each(some)):
            add(relit)
            assert relit.eye_reflections is not None and relit.mouth is not None
            maps = [*relit.tensors, relit.eye_reflections, relit.mouth]
            total = [one + of_all for one, of_all in zip(maps, total, strict=True)] if total else maps
    texture, *maps, mirrored, mouth = (one / len(rig) for one in total)
    count = len(maps) // len(field.views)
    views = tuple(PersonShading(*maps[at : at + count]) for at in range(0, len(maps), count))
    mean = Relit(texture, views=views, eye_reflections=mirrored, mouth=mouth)
    add(replace(mean, eye_reflections=torch.zeros_like(mirrored)))  # eyes that reflect no room
    large_mean = people.light_layer([mean])
    classes, source = field.person.classes.numpy(), field.person.image.permute(1, 2, 0).numpy()
    samples = LightSamples.of(np.stack(coarse), 1 - classes[0], classes[class_index("skin")], source)
    return Basis.of(rig.numpy(), np.stack(images), large_mean, people.matte, samples)


def _shrunk(field: PortraitField, photo: np.ndarray, width: int, height: int) -> PortraitField:
    """Return the field for the photo at a smaller size."""
    segmentation = field.person.segmentation
    segmentation = replace(segmentation, matte=resized(segmentation.matte, height, width))
    scale = width / photo.shape[1]

    def shrunk(view: PortraitView) -> PortraitView:
        person = view.person
        normals = None if person.normals is None else resized(person.normals, height, width)
        square, eyes = person.square.of_scaled(scale), person.eyes.scaled(scale)
        person = replace(person, square=square, segmentation=segmentation, eyes=eyes, normals=normals)
        return replace(view, person=person)

    return replace(field, views=tuple(map(shrunk, field.views)))


def basis_of_stack(
    directions: np.ndarray,
    batches: Iterable[Tensor],
    seen: np.ndarray,
    most_px: int,
    face: np.ndarray | None = None,
    photo: np.ndarray | None = None,
) -> Basis:
    """Make the basis of a stack, from batches of images [l, 3, H, W] over black, at most `most_px` large.

    `seen` [H, W] is the person's matte, `face` the face's. The exposure keeps the face's brightness in the
    `photo` [H, W, 3].
    """
    kept = evenly_spread(directions)
    size = fitted(seen.shape[0], seen.shape[1], most_px)
    small_size = fitted(*size, RATIO_PX)
    mean, images = np.zeros((*seen.shape, 3), np.float32), []
    each = (image for batch in batches for image in batch.permute(0, 2, 3, 1).numpy())
    for light, image in enumerate(each):
        if light in kept:
            mean += image / len(kept)
            images.append(resized(image, *small_size).astype(np.float16))
    small, share = np.stack(images), resized(seen, *small_size)
    smaller = [None if x is None else resized(x, *small_size) for x in (face, photo)]
    straight = small / share.clip(_PERSON)[..., None].astype(np.float16)
    samples = LightSamples.of(straight, share, *smaller)
    return Basis.of(directions[kept], small, resized(mean, *size), resized(seen, *size), samples)


def evenly_spread(directions: np.ndarray, most: int = MOST_LIGHTS) -> list[int]:
    """Return the sorted indices of at most `most` lights [L, 3], spread over the sphere."""
    if len(directions) <= most:
        return list(range(len(directions)))
    return sorted({int(i) for i in (rig_directions(most).numpy() @ directions.T).argmax(1)})
