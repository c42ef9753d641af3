"""Basis images of an OLAT stack: an image under any light is a guide times a weighted sum of ratios.

The guide is the mean of all lights' images, as large as the photo, and keeps every pore and hair. A ratio,
a light's image over the guide, is smooth, so it is small. Both are bytes: the guide of sRGB, a ratio of its
square root.
"""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace

import numpy as np
import torch
from scipy.ndimage import distance_transform_edt
from torch import Tensor

from facerf_cli.face.head import Head, shrunk_photo
from facerf_cli.image.colour import (
    AUTO_EXPOSURE_PERCENTILE,
    FACE_PERCENTILE,
    linear_to_srgb,
    luminance,
    srgb_to_linear,
)
from facerf_cli.image.strips import fitted, resized, whole
from facerf_cli.light.sphere import rig_directions
from facerf_cli.light.studio_points import Lights
from facerf_cli.pipeline import Person
from facerf_cli.portrait.classes import class_index
from facerf_cli.relighting.composition import Composition, Relit
from facerf_cli.relighting.models import Models
from facerf_cli.relighting.portrait_field import PortraitField

RATIO_PX = 320  # the longer side of a ratio
MOST_LIGHTS = 400  # of a stack with more, so many evenly spread ones are kept
_LIGHTS_AT_ONCE = 10
_DARK = 5e-3  # added to the guide, as a share of its mean over the person: no ratio divides by 0
_PERSON = 0.02  # share of the person from which on a pixel has a ratio
_SURE = 0.5  # share from which on a pixel is skin, or the person's
_SAMPLES = 700  # pixels of the face, and of the person, by which a page chooses its exposure
_WHITE_PERCENTILE = 99.9  # of a guide and of a ratio: the white of their bytes


@dataclass(frozen=True, eq=False)
class LightSamples:
    """Pixels of a person by which the exposure is chosen: `face` [L, F, 3] and `person` [L, P, 3].

    `plate` is the brightness of both in the photo, at the percentiles of `relight`; None shows them well.
    """

    face: np.ndarray
    person: np.ndarray
    plate: tuple[float, float] | None = None


@dataclass(frozen=True, eq=False)
class Basis:
    """A person over black under lights [L, 3], as ratios [L, h, w, 3] to a guide [H, W, 3], in bytes.

    The linear guide is that of sRGB times `white`; a linear ratio (byte / 255)^2 times `scales` [L].
    """

    directions: np.ndarray
    ratios: np.ndarray
    scales: np.ndarray
    guide: np.ndarray
    white: float
    samples: LightSamples

    @staticmethod
    def of(
        directions: np.ndarray,
        images: np.ndarray,
        mean: np.ndarray,
        matte: np.ndarray,
        samples: LightSamples | None = None,
    ) -> "Basis":
        """The basis of small images [L, h, w, 3], their mean [H, W, 3] and the matte [H, W].

        The samples are by default those of the images.
        """
        dark = np.float32(_DARK * mean.sum() / max(3 * float(matte.sum()), 1.0))
        guide = np.maximum(mean, 0) + dark * matte[..., None]
        white = max(float(np.percentile(guide, _WHITE_PERCENTILE)), 1e-9)
        encoded = np.round(255 * linear_to_srgb((guide / white).clip(0, 1))).astype(np.uint8)
        size = images.shape[1:3]
        share = resized(matte, *size)
        below = np.maximum(resized(_linear(encoded, white), *size), dark * share.clip(_PERSON)[..., None])
        outside = share < _PERSON
        nearest = tuple(distance_transform_edt(outside, return_distances=False, return_indices=True))
        ratios, scales = np.empty(images.shape, np.uint8), np.empty(len(images), np.float32)
        for light, image in enumerate(images):
            ratio = (np.maximum(image.astype(np.float32), 0) / below)[nearest]
            scales[light] = max(float(np.percentile(ratio, _WHITE_PERCENTILE)), 1e-9)
            ratios[light] = np.round(255 * np.sqrt((ratio / scales[light]).clip(0, 1)))
        if samples is None:
            person = _some(share > _SURE)
            straight = images.reshape(len(images), -1, 3)[:, person] / share.reshape(-1, 1)[person]
            samples = LightSamples(straight, straight)
        return Basis(directions, ratios, scales, encoded, white, samples)

    @property
    def linear_guide(self) -> np.ndarray:
        """The guide [H, W, 3], scene-linear, as a page reads it."""
        return _linear(self.guide, self.white)

    def image(self, toward: np.ndarray) -> np.ndarray:
        """The small image [h, w, 3] over black under the light that is nearest to a direction [3]."""
        light = int((self.directions @ toward).argmax())
        return np.asarray(resized(self.linear_guide, *self.ratios.shape[1:3]) * self._ratio(light))

    def anchored(self, photo: np.ndarray, face: np.ndarray, matte: np.ndarray) -> "Basis":
        """The basis whose exposure leaves a face, a share [H, W], as bright as in the photo [H, W, 3]."""
        size = self.ratios.shape[1:3]
        plate = luminance(resized(photo, *size))
        share, skin = resized(matte, *size), resized(face, *size)
        places, masks = (_some(skin > _SURE), _some(share > _SURE)), (skin > _SURE, share > _SURE)
        straight = resized(self.linear_guide, *size) / share.clip(_PERSON)[..., None]
        found = [
            np.stack([self._ratio(light).reshape(-1, 3)[some] for light in range(len(self.ratios))])
            * straight.reshape(-1, 3)[some]
            for some in places
        ]
        percentiles = (FACE_PERCENTILE, AUTO_EXPOSURE_PERCENTILE)
        bright = [
            float(np.percentile(plate[m], p)) if m.any() else 0.0
            for m, p in zip(masks, percentiles, strict=True)
        ]
        return replace(self, samples=LightSamples(found[0], found[1], (bright[0], bright[1])))

    def _ratio(self, light: int) -> np.ndarray:
        return np.asarray((self.ratios[light].astype(np.float32) / 255) ** 2 * self.scales[light])


def _some(mask: np.ndarray) -> np.ndarray:
    """Places of at most about `_SAMPLES` pixels of a mask [H, W], evenly taken, in its flat order."""
    places = np.flatnonzero(mask)
    return places[:: max(1, len(places) // _SAMPLES)]


def _linear(encoded: np.ndarray, white: float) -> np.ndarray:
    return np.asarray(srgb_to_linear(encoded.astype(np.float32) / 255) * np.float32(white))


def basis_of_photo(
    models: Models, photo: np.ndarray, head: Head, field: PortraitField, composition: Composition
) -> Basis:
    """The basis of a photo's person under the lights over which `facerf relight` integrates maps.

    The images of single lights are composed small; their mean is composed as large as the photo [H, W, 3].
    """
    small_photo, small_head = shrunk_photo(photo, head, RATIO_PX)
    small_field = _shrunk(field, photo, small_photo.shape[1], small_photo.shape[0])
    small = Person(models, small_photo, small_head, small_field).composed()
    rig = rig_directions()
    images: list[np.ndarray] = []
    coarse: list[np.ndarray] = []
    mean: Relit | None = None
    for relit in _single(composition, rig):
        assert relit.surround is not None
        images.append(whole(small.light_layer(relit), *small.size_px).astype(np.float16))
        part = field.maps.albedo[0] * relit.surround[:3] + relit.surround[3:6]
        coarse.append((part * field.exposure).flatten(1).T.numpy().astype(np.float16))
        mean = relit if mean is None else mean.plus(torch.ones(1), relit.texture, relit.surround)
    assert mean is not None and mean.surround is not None
    mean = Relit(mean.texture / len(rig), mean.surround / len(rig))
    shown = whole(composition.light_layer(mean), *composition.size_px)
    samples = _samples(np.stack(coarse), field)
    return Basis.of(rig.numpy(), np.stack(images), shown, composition.matte, samples)


def _samples(coarse: np.ndarray, field: PortraitField) -> LightSamples:
    """The samples of a photo's person, whose images [L, S S, 3] are as coarse as the maps of its field."""
    classes = field.person.classes.numpy()
    face, person = classes[class_index("skin")] > _SURE, 1 - classes[0] > _SURE
    photo = luminance(field.person.image.permute(1, 2, 0).numpy())
    plate = [
        float(np.percentile(photo[mask], percentile)) if mask.any() else 0.0
        for mask, percentile in ((face, FACE_PERCENTILE), (person, AUTO_EXPOSURE_PERCENTILE))
    ]
    return LightSamples(coarse[:, _some(face)], coarse[:, _some(person)], (plate[0], plate[1]))


def _single(composition: Composition, lights: Tensor) -> Iterator[Relit]:
    """A head under each of lights [L, 3] of rgb 1."""
    for some in torch.split(lights, _LIGHTS_AT_ONCE):
        yield from composition.relit(Lights.each(some))


def _shrunk(field: PortraitField, photo: np.ndarray, width: int, height: int) -> PortraitField:
    """The same field for the photo at a smaller size."""
    person = field.person
    segmentation = replace(person.segmentation, matte=resized(person.segmentation.matte, height, width))
    square = person.square.of_scaled(width / photo.shape[1])
    return replace(field, person=replace(person, square=square, segmentation=segmentation))


def basis_of_stack(
    directions: np.ndarray, batches: Callable[[], Iterable[Tensor]], seen: np.ndarray, most_px: int
) -> Basis:
    """The basis of a stack, shown with `most_px` pixels at most along the longer side.

    Its images are read in batches [l, 3, H, W] over black; `seen` [H, W] is the person's share.
    """
    kept = evenly_spread(directions)
    size = fitted(seen.shape[0], seen.shape[1], most_px)
    small_size = fitted(*size, RATIO_PX)
    mean, images = np.zeros((*seen.shape, 3), np.float32), []
    each = (image for batch in batches() for image in batch.permute(0, 2, 3, 1).numpy())
    for light, image in enumerate(each):
        if light in kept:
            mean += image / len(kept)
            images.append(resized(image, *small_size).astype(np.float16))
    return Basis.of(directions[kept], np.stack(images), resized(mean, *size), resized(seen, *size))


def evenly_spread(directions: np.ndarray, most: int = MOST_LIGHTS) -> list[int]:
    """Lights [L, 3] to keep, at most so many, spread over the sphere; in order."""
    if len(directions) <= most:
        return list(range(len(directions)))
    return sorted({int(i) for i in (rig_directions(most).numpy() @ directions.T).argmax(1)})
