"""Follow one person through the frames of a shot: one identity, one light, and temporally smoothed maps.

Maps are smoothed by a bilateral filter along time (Tomasi and Manduchi, *Bilateral filtering for gray and
color images*, 1998): a neighbouring frame contributes to a pixel to the extent that its image looks the same
there.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from facerf_cli.errors import InputError
from facerf_cli.face.crop import Crop, from_landmarks
from facerf_cli.face.fit import FaceFit, fit_batch, fit_landmarks, trust_inside
from facerf_cli.face.head import Head, unwrap_face
from facerf_cli.face.morphable import MorphableModel
from facerf_cli.image.colour import to_display
from facerf_cli.light.sphere import RigLight
from facerf_cli.network.portrait import PortraitMaps
from facerf_cli.portrait.parse import uncovered_in
from facerf_cli.portrait.person import SeenPerson, look_at_person, portrait_square, wider_square
from facerf_cli.portrait.segment import (
    Segmentation,
    parsed,
    predicted_classes,
    segmentation_of,
    small_image,
    within_matte,
)
from facerf_cli.relighting import BalanceMode
from facerf_cli.relighting.field import balance_of
from facerf_cli.relighting.models import Models, Sides
from facerf_cli.relighting.photo_light import light_of_frames, source_light
from facerf_cli.relighting.portrait_field import SmoothedFrame, maps_of
from facerf_cli.relighting.tracking import Sighting, path_of
from facerf_cli.relighting.white import WhiteBalance

MAPS_REACH = 2  # frames on each side of a map's window
_ALIKE = 0.03  # difference of images, in 0..1, at which a neighbour's weight falls to 0.6
_BLUR_PX = 3  # side of the square over which images are compared, because of their noise
_TINY = 1e-9


def steadied(maps: Sequence[Tensor], images: Sequence[Tensor], middle: int) -> Tensor:
    """Return the mean over time of maps [C, h, w] of neighbouring frames, for the frame `middle` of them.

    Display-encoded images [3, h, w] in 0..1 tell where the frames look alike.
    """
    own = _blurred(images[middle])
    total, weights = torch.zeros_like(maps[middle]), torch.zeros_like(own[:1])
    for index, (one, image) in enumerate(zip(maps, images, strict=True)):
        apart = (_blurred(image) - own).square().mean(0, keepdim=True)
        near = 1 - abs(index - middle) / (MAPS_REACH + 1)
        weight = near * torch.exp(-apart / (2 * _ALIKE**2))
        total, weights = total + weight * one, weights + weight
    return total / weights.clamp_min(_TINY)


def _blurred(image: Tensor) -> Tensor:
    return F.avg_pool2d(image[None], _BLUR_PX, stride=1, padding=_BLUR_PX // 2, count_include_pad=False)[0]


_KEYS = 12  # frames whose identities are averaged


def spread_over(frames: Sequence[int], count: int) -> list[int]:
    """Return at most `count` of some frames, evenly spread, including the first and the last."""
    at = np.linspace(0, len(frames) - 1, min(count, len(frames))).round().astype(int)
    return [frames[index] for index in dict.fromkeys(at.tolist())]


def identity_of(
    model: MorphableModel, landmarks_px: Sequence[np.ndarray], shape: tuple[int, int], crop_px: int
) -> Tensor:
    """Fit the identity [Ki] of one person to landmarks [68, 2] in several frames of shape [H, W]."""
    keys = [landmarks_px[index] for index in spread_over(range(len(landmarks_px)), _KEYS)]
    crops = [from_landmarks(px, crop_px) for px in keys]
    inside = [crop.to_crop(px) for crop, px in zip(crops, keys, strict=True)]
    trust = [trust_inside(px, crop, *shape) for px, crop in zip(inside, crops, strict=True)]
    target = torch.from_numpy(np.stack(inside))
    fits = fit_batch(model, target, crops[0].camera, trust=torch.from_numpy(np.stack(trust)))
    return fits.alpha.mean(0).float()


class OnePerson:
    """Person of known identity alpha [Ki] in frames of a size (height, width)."""

    def __init__(self, model: MorphableModel, alpha: Tensor, size_px: tuple[int, int], crop_px: int) -> None:
        self._alpha, self._size_px, self._crop_px = alpha, size_px, crop_px
        mean = model.vertices(alpha[None], torch.zeros(1, len(model.expression)))[0]
        self._model = replace(model, mean=mean, identity=model.identity[:0])

    def fit(self, landmarks_px: np.ndarray) -> FaceFit:
        """Fit pose and expression to landmarks [68, 2] in a frame."""
        crop = from_landmarks(landmarks_px, self._crop_px)
        inside = crop.to_crop(landmarks_px)
        fit = fit_landmarks(self._model, inside, crop, trust=trust_inside(inside, crop, *self._size_px))
        return replace(fit, alpha=self._alpha)


KEY_FRAMES = 5  # frames that the light is estimated from
_UNIT = ("normals", "strands")  # maps of unit vectors


@dataclass(eq=False)
class _FrameObservation:
    """Classes [C, h, w] predicted for one frame, its small image, and results that are computed on demand."""

    classes: Tensor
    small: Tensor
    fit: FaceFit | None = None
    segmentation: Segmentation | None = None
    views: list[tuple[SeenPerson, PortraitMaps]] | None = None


class SteadyShot:
    """Person through the frames of a shot, each frame smoothed with its neighbours.

    Observations are kept only for frames near the last requested one, so networks run once per frame if
    frames are requested in order. Results for the whole shot are computed on first use and kept.

    `frames` returns a frame by number, scene-linear [H, W, 3] of one size. `mattes` returns the user's alpha
    [H, W] of the person, which is black if a frame does not show the person.
    """

    def __init__(
        self,
        models: Models,
        frames: Callable[[int], np.ndarray],
        sightings: Sequence[Sighting | None],
        sides: Sides,
        mattes: Callable[[int], np.ndarray] | None = None,
        white_balance: BalanceMode | None = None,
    ) -> None:
        self._models, self._frames, self._mattes = models, frames, mattes
        self._sides, self._white_balance = sides, white_balance
        self._path = path_of(sightings)  # [N, 68, 2], NaN where the face is lost
        self._sighted = [frame for frame, sighting in enumerate(sightings) if sighting]
        self._tracked = frozenset(np.flatnonzero(np.isfinite(self._path).all((1, 2))).tolist())
        self._near: dict[int, _FrameObservation] = {}

    def window(self, frame: int, portrait: bool = True) -> SmoothedFrame:
        """Return a frame smoothed with its neighbours; `portrait` includes what the portrait field needs."""
        light, balance = self.light, self._balance  # from other frames, before those around this one
        self._keep_near(frame)
        views = self._smoothed_views(frame) if portrait and self._shows_person(frame) else ()
        head = self._key_heads.get(frame) or self._head(frame)
        return SmoothedFrame(head, light, self._segmentation(frame), views, balance)

    def segmentation(self, frame: int) -> Segmentation:
        """Segment the person in a frame, from the classes of its neighbours."""
        self._keep_near(frame)
        return self._segmentation(frame)

    def landmarks_px(self, frame: int) -> np.ndarray:
        """Return the smoothed landmarks [68, 2] in a frame; raises InputError if the face is lost."""
        if frame not in self._tracked:
            raise InputError(f"frame {frame}: the face is not visible for more frames than can be bridged")
        return np.asarray(self._path[frame])

    @cached_property
    def key_frames(self) -> list[int]:
        """Representative frames, evenly spread over those with a sighting, and a matte that is not black."""
        if not self._sighted:
            raise InputError("no frame shows a face")
        keys = spread_over(self._sighted, KEY_FRAMES)
        return [frame for frame in keys if self._shows_person(frame)] or keys

    @property
    def middle(self) -> int:
        return self.key_frames[len(self.key_frames) // 2]

    @property
    def other_heads(self) -> list[Head]:
        """Heads in all key frames but the middle one."""
        return [head for frame, head in self._key_heads.items() if frame != self.middle]

    @cached_property
    def light(self) -> RigLight:
        """Light of the shot, estimated from all key frames together."""
        return light_of_frames(self._models, [head.face for head in self._key_heads.values()])

    @cached_property
    def _balance(self) -> WhiteBalance | None:
        if self._white_balance is None:
            return None
        faces = [head.face for head in self._key_heads.values()]
        uniform = [source_light(self._models, one, self.light).uniform for one in faces]
        return balance_of(self._white_balance, list(zip(faces, uniform, strict=True)))

    @cached_property
    def _key_heads(self) -> dict[int, Head]:
        heads = {}
        for frame in self.key_frames:
            self._keep_near(frame)
            heads[frame] = self._head(frame)
        return heads

    @cached_property
    def _person(self) -> OnePerson:
        size_px, crop_px = self._frames(self._sighted[0]).shape[:2], self._sides.crop_px
        landmarks_px = [self._path[frame] for frame in self._sighted]
        alpha = identity_of(self._models.face, landmarks_px, size_px, crop_px)
        return OnePerson(self._models.face, alpha, size_px, crop_px)

    @cached_property
    def _wide(self) -> tuple[float, float, float] | None:
        """Offset and side of the wider square in the middle of the shot, in sides of the head's square."""
        fit = self._fit(self.middle)
        head = portrait_square(fit.crop.to_photo(fit.landmarks_px.numpy()))
        wide = wider_square(head, self._segmentation(self.middle).matte)
        if wide is None:
            return None
        offsets = wide.x0_px - head.x0_px, wide.y0_px - head.y0_px
        return offsets[0] / head.side_px, offsets[1] / head.side_px, wide.side_px / head.side_px

    def _shows_person(self, frame: int) -> bool:
        return self._mattes is None or bool(self._mattes(frame).any())

    def _around(self, frame: int) -> list[int]:
        """Return the frame and its neighbours, up to the nearest frames in which the face is lost."""
        frames = [frame]
        for step in (-1, 1):
            at = frame + step
            while abs(at - frame) <= MAPS_REACH and 0 <= at < len(self._path) and at in self._tracked:
                frames.append(at)
                at += step
        return sorted(frames)

    def _keep_near(self, frame: int) -> None:
        """Release observations far from a frame; its neighbours need their own neighbours."""
        reach = 2 * MAPS_REACH
        self._near = {at: observed for at, observed in self._near.items() if abs(at - frame) <= reach}

    def _observed(self, frame: int) -> _FrameObservation:
        if frame not in self._near:
            people, landmarks_px = self._models.networks.people, self.landmarks_px(frame)
            image = to_display(self._frames(frame))
            small = small_image(image)
            if self._mattes is not None:
                classes = parsed(people.parsing, image, landmarks_px, small)
            else:
                classes = predicted_classes(people, image, landmarks_px, small)
            self._near[frame] = _FrameObservation(classes, small)
        return self._near[frame]

    def _segmentation(self, frame: int) -> Segmentation:
        observed = self._observed(frame)
        if observed.segmentation is None:
            around = self._around(frame)
            near = [self._observed(one) for one in around]
            mean = steadied([one.classes for one in near], [one.small for one in near], around.index(frame))
            mean = mean / mean.sum(0).clamp_min(1e-6)
            if self._mattes is not None:
                observed.segmentation = within_matte(mean, self._mattes(frame))
            else:
                image = to_display(self._frames(frame))
                observed.segmentation = segmentation_of(mean, image, self.landmarks_px(frame))
        return observed.segmentation

    def _fit(self, frame: int) -> FaceFit:
        observed = self._observed(frame)
        if observed.fit is None:
            observed.fit = self._person.fit(self.landmarks_px(frame))
        return observed.fit

    def _head(self, frame: int) -> Head:
        model, fit, photo = self._models.face, self._fit(frame), self._frames(frame)
        cropped = fit.crop.apply(photo)
        head = Head(cropped, fit, unwrap_face(model, fit, cropped, self._sides.texture, photo.shape))
        height, width = photo.shape[:2]
        classes = self._segmentation(frame).classes
        try:
            return head.without(model, uncovered_in(classes, (height, width), fit.crop))
        except InputError:  # in this frame something covers the whole face
            return head

    def _views(self, frame: int) -> list[tuple[SeenPerson, PortraitMaps]]:
        """Return the person around the head and, if the shot needs it, in a wider square around that."""
        observed = self._observed(frame)
        if observed.views is None:
            networks, photo = self._models.networks, self._frames(frame)
            fit, segmentation = self._fit(frame), self._segmentation(frame)
            person = look_at_person(networks.people, self._models.face, photo, fit, segmentation=segmentation)
            people = [person]
            if self._wide is not None:
                head = person.square
                x, y, side = (part * head.side_px for part in self._wide)
                people.append(person.within(Crop(head.x0_px + x, head.y0_px + y, side, head.size_px), photo))
            observed.views = [(one, maps_of(networks.portrait, one)) for one in people]
        return observed.views

    def _smoothed_views(self, frame: int) -> tuple[tuple[SeenPerson, PortraitMaps], ...]:
        """Return the person in a frame, and maps averaged with its neighbours'; squares follow the head."""
        around = [one for one in self._around(frame) if self._shows_person(one)]
        views = zip(*(self._views(one) for one in around), strict=True)
        middle = around.index(frame)
        return tuple((near[middle][0], _smoothed_maps(near, middle)) for near in views)


def _smoothed_maps(near: Sequence[tuple[SeenPerson, PortraitMaps]], middle: int) -> PortraitMaps:
    images = [(person.exposed / 2).clamp(0, 1).pow(1 / 2.2) for person, _ in near]
    halves = [F.avg_pool2d(image[None], 2)[0] for image in images]
    means: dict[str, Tensor] = {}
    for name in PortraitMaps._fields:
        if name == "albedo":
            continue
        layers = [getattr(maps, name)[0] for _, maps in near]
        if name == "gain":
            layers = [layer.log() for layer in layers]
        mean = steadied(layers, images if layers[0].shape[-1] == images[0].shape[-1] else halves, middle)
        if name in _UNIT:
            mean = F.normalize(mean, dim=0)
        means[name] = (mean.exp() if name == "gain" else mean)[None]
    person = near[middle][0]
    albedo = person.exposed[None] * means["gain"] + means["bias"]
    return PortraitMaps(albedo=albedo, **means)
