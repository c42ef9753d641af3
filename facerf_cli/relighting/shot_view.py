"""The frames of a shot as they are relit: each steadied by those around it.

What a frame needs of its neighbours is computed once, as frames are asked for in order, and kept no longer
than it is needed; so memory does not grow with the length of the shot. The identity is the mean of the
identities of key frames, each fitted as a photo is; with it held, each frame's pose and expression are fitted
to its smoothed landmarks.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import cache, cached_property, lru_cache

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from facerf_cli.errors import InputError
from facerf_cli.face.crop import Crop, from_landmarks
from facerf_cli.face.fit import FaceFit, fit_batch, trust_inside
from facerf_cli.face.head import Head, unwrap_face
from facerf_cli.face.landmarks import to_display
from facerf_cli.face.morphable import MorphableModel
from facerf_cli.light.sphere import RigLight
from facerf_cli.network.portrait import PortraitMaps
from facerf_cli.portrait.occluders import uncovered_in
from facerf_cli.portrait.person import SeenPerson, look_at_person
from facerf_cli.portrait.segment import Segmentation, seen_classes, segmentation_of, small_image
from facerf_cli.relighting.follow import MAPS_REACH, Sighting, path_of, steadied
from facerf_cli.relighting.models import Models, Sides
from facerf_cli.relighting.own_light import light_of_frames
from facerf_cli.relighting.portrait_field import SteadyFrame, maps_of

_KEYS = 12  # frames whose identities are averaged
_AT_ONCE = 32  # frames that are fitted together


def spread_over(frames: Sequence[int], count: int) -> list[int]:
    """At most `count` of some frames, evenly spread, the first and the last among them."""
    at = np.linspace(0, len(frames) - 1, min(count, len(frames))).round().astype(int)
    return [frames[index] for index in dict.fromkeys(at.tolist())]


def identity_of(
    model: MorphableModel, landmarks_px: Sequence[np.ndarray], shape: tuple[int, int], crop_px: int
) -> Tensor:
    """The identity [Ki] of one person from landmarks [68, 2] of several frames of shape [H, W]."""
    keys = [landmarks_px[index] for index in spread_over(range(len(landmarks_px)), _KEYS)]
    crops = [from_landmarks(px, crop_px) for px in keys]
    target, trust = _in_crops(keys, crops, shape)
    return fit_batch(model, target, crops[0].camera, trust=trust).alpha.mean(0).float()


def fit_frames(
    model: MorphableModel,
    alpha: Tensor,
    landmarks_px: Sequence[np.ndarray],
    shape: tuple[int, int],
    crop_px: int,
) -> Iterator[FaceFit]:
    """Fit pose and expression of a person alpha [Ki] to each frame's landmarks [68, 2]."""
    person = _of_one_person(model, tuple(alpha.tolist()))
    for first in range(0, len(landmarks_px), _AT_ONCE):
        some = landmarks_px[first : first + _AT_ONCE]
        crops = [from_landmarks(px, crop_px) for px in some]
        target, trust = _in_crops(some, crops, shape)
        fits = fit_batch(person, target, crops[0].camera, trust=trust)
        for index, crop in enumerate(crops):
            yield FaceFit(
                model=model.name,
                crop=crop,
                rotation=fits.rotation[index].float(),
                translation_m=fits.translation_m[index].float(),
                alpha=alpha,
                beta=fits.beta[index].float(),
                landmarks_px=target[index].float(),
                error_iod=float(fits.error_iod[index]),
            )


@cache
def _of_one_person(model: MorphableModel, alpha: tuple[float, ...]) -> MorphableModel:
    """The face model with one identity only; kept, since the fit keeps what it derives from a model."""
    mean = model.vertices(torch.tensor([alpha]), torch.zeros(1, len(model.expression)))[0]
    return replace(model, name=f"{model.name}-person", mean=mean, identity=model.identity[:0], head=None)


def _in_crops(
    landmarks_px: Sequence[np.ndarray], crops: Sequence[Crop], shape: tuple[int, int]
) -> tuple[Tensor, Tensor]:
    """Landmarks [B, 68, 2] in the pixels of their crops, and their trust [B, 68]."""
    inside = [crop.to_crop(px) for crop, px in zip(crops, landmarks_px, strict=True)]
    trust = [trust_inside(px, crop, *shape) for px, crop in zip(inside, crops, strict=True)]
    return torch.from_numpy(np.stack(inside)), torch.from_numpy(np.stack(trust))


KEY_FRAMES = 5  # from which the light is estimated
_KEPT = 2 * (2 * MAPS_REACH + 1)  # frames of which something is kept
_UNIT = ("normals", "strands")  # maps of unit vectors


class ShotView:
    """A person through a shot, whose face was sighted in some frames.

    `read` gives frames [H, W, 3], scene-linear, by number.
    """

    def __init__(
        self,
        models: Models,
        sides: Sides,
        read: Callable[[int], np.ndarray],
        sightings: Sequence[Sighting | None],
    ) -> None:
        self._models, self._sides, self._read = models, sides, read
        self._path = path_of(sightings)  # [N, 68, 2], NaN where the face is lost
        self._sighted = [frame for frame, seen in enumerate(sightings) if seen]
        self._shown = frozenset(np.flatnonzero(np.isfinite(self._path).all((1, 2))).tolist())
        self._display = lru_cache(2)(lambda frame: to_display(read(frame)))
        self._classes = lru_cache(_KEPT)(self._look)
        self.head: Callable[[int], Head] = lru_cache(_KEPT)(self._seen_head)  # without what covers its skin
        self.segmentation: Callable[[int], Segmentation] = lru_cache(_KEPT)(self._segmentation)
        self._person = lru_cache(_KEPT)(self._seen_person)
        self._maps = lru_cache(_KEPT)(lambda frame: maps_of(models.networks.portrait, self._person(frame)))

    def _seen_head(self, frame: int) -> Head:
        model, fit, photo = self._models.face, self._fit(frame), self._read(frame)
        cropped = fit.crop.apply(photo)
        head = Head(cropped, fit, unwrap_face(model, fit, cropped, self._sides.texture, photo.shape))
        height, width = photo.shape[:2]
        classes = self.segmentation(frame).classes
        try:
            return head.without(model, uncovered_in(classes, (height, width), fit.crop))
        except InputError:  # all of it is covered: in this frame something passes before it
            return head

    def steady(self, frame: int, portrait: bool = True) -> SteadyFrame:
        """A frame as those around it steady it; `portrait` says whether the portrait field is wanted."""
        maps = (self._person(frame), self._steady_maps(frame)) if portrait else None
        return SteadyFrame(self.light, self.segmentation(frame), maps)

    @cached_property
    def light(self) -> RigLight:
        """The light of the shot, from key frames together."""
        heads = [self.head(frame) for frame in self.key_frames]
        return light_of_frames(self._models, [head.face for head in heads])

    @cached_property
    def key_frames(self) -> list[int]:
        """Frames that stand for the shot, evenly spread over those in which the face was sighted."""
        if not self._sighted:
            raise InputError("no frame shows a face")
        return spread_over(self._sighted, KEY_FRAMES)

    @property
    def middle_first(self) -> list[int]:
        """The key frames, that of the middle first."""
        keys = self.key_frames
        middle = keys[len(keys) // 2]
        return [middle, *(key for key in keys if key != middle)]

    @cached_property
    def _identity(self) -> Tensor:
        shape = self._read(self._sighted[0]).shape
        places = [self._path[frame] for frame in self._sighted]
        return identity_of(self._models.face, places, (shape[0], shape[1]), self._sides.crop_px)

    def landmarks_px(self, frame: int) -> np.ndarray:
        """Smoothed landmarks [68, 2] of a frame; raises InputError where the face is lost."""
        if frame not in self._shown:
            raise InputError(f"frame {frame}: the face is lost, in more frames than are bridged")
        found: np.ndarray = self._path[frame]
        return found

    def _fit(self, frame: int) -> FaceFit:
        landmarks_px = self.landmarks_px(frame)
        shape = self._read(frame).shape
        return next(
            fit_frames(
                self._models.face,
                self._identity,
                [landmarks_px],
                (shape[0], shape[1]),
                self._sides.crop_px,
            )
        )

    def _around(self, frame: int) -> list[int]:
        """The frame and its neighbours that show the face, without those beyond a frame where it is lost."""
        found = [frame]
        for step in (-1, 1):
            at = frame + step
            while abs(at - frame) <= MAPS_REACH and 0 <= at < len(self._path) and at in self._shown:
                found.append(at)
                at += step
        return sorted(found)

    def _look(self, frame: int) -> tuple[Tensor, Tensor]:
        """Classes of a frame alone, and the small image that they were seen in."""
        image = self._display(frame)
        small = small_image(image)
        return seen_classes(self._models.networks.parsing, image, self.landmarks_px(frame), small), small

    def _segmentation(self, frame: int) -> Segmentation:
        around = self._around(frame)
        classes, images = zip(*(self._classes(one) for one in around), strict=True)
        own = around.index(frame)
        mean = steadied(classes, images, own)
        return segmentation_of(mean / mean.sum(0).clamp_min(1e-6), self._display(frame), images[own])

    def _seen_person(self, frame: int) -> SeenPerson:
        fit, segmentation = self._fit(frame), self.segmentation(frame)
        return look_at_person(
            self._models.networks.parsing,
            self._models.face,
            self._read(frame),
            fit,
            segmentation=segmentation,
        )

    def _steady_maps(self, frame: int) -> PortraitMaps:
        """Maps of a frame, averaged with its neighbours' in the square, which follows the head."""
        around = self._around(frame)
        middle = around.index(frame)
        maps = [self._maps(one) for one in around]
        images = [_encoded(self._person(one)) for one in around]
        halves = [F.avg_pool2d(image[None], 2)[0] for image in images]

        def mean(name: str) -> Tensor:
            layers = [getattr(one, name)[0] for one in maps]
            if name == "gain":
                layers = [layer.log() for layer in layers]
            seen = images if layers[0].shape[-1] == images[0].shape[-1] else halves
            found = steadied(layers, seen, middle)
            if name in _UNIT:
                found = F.normalize(found, dim=0)
            return (found.exp() if name == "gain" else found)[None]

        means = {name: mean(name) for name in PortraitMaps._fields if name != "albedo"}
        person = self._person(frame)
        albedo = person.image[None] / person.exposure * means["gain"] + means["bias"]
        return PortraitMaps(albedo=albedo, **means)


def _encoded(person: SeenPerson) -> Tensor:
    """The person's image [3, S, S] for comparison, display-encoded in 0..1; the skin is about middle grey."""
    return (person.image / person.exposure / 2).clamp(0, 1).pow(1 / 2.2)
