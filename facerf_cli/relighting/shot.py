"""One person through the frames of a shot: one identity and one light, and maps that are smoothed over time.

Maps are smoothed by a bilateral filter along time (Tomasi and Manduchi, *Bilateral filtering for gray and
color images*, 1998): a pixel takes part in the mean as far as the image there looks as it does in the frame
itself.
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
    seen_classes,
    segmentation_of,
    small_image,
    within_matte,
)
from facerf_cli.relighting import White
from facerf_cli.relighting.field import balance_of
from facerf_cli.relighting.models import Models, Sides
from facerf_cli.relighting.photo_light import light_of_frames, source_light
from facerf_cli.relighting.portrait_field import SteadyFrame, maps_of
from facerf_cli.relighting.tracking import Sighting, path_of
from facerf_cli.relighting.white import Balance

MAPS_REACH = 2  # frames on each side of a map's window
_ALIKE = 0.03  # difference of images, in 0..1, at which a neighbour's weight falls to 0.6
_BLUR_PX = 3  # side of the square over which images are compared, against their noise
_TINY = 1e-9


def steadied(maps: Sequence[Tensor], images: Sequence[Tensor], middle: int) -> Tensor:
    """Mean over time of maps [C, h, w] of neighbouring frames, for the frame `middle` of them.

    images [3, h, w] in 0..1, display-encoded, say where the frames look alike.
    """
    own = _blurred(images[middle])
    total, weight = torch.zeros_like(maps[middle]), torch.zeros_like(own[:1])
    for index, (one, image) in enumerate(zip(maps, images, strict=True)):
        apart = (_blurred(image) - own).square().mean(0, keepdim=True)
        near = 1 - abs(index - middle) / (MAPS_REACH + 1)
        share = near * torch.exp(-apart / (2 * _ALIKE**2))
        total, weight = total + share * one, weight + share
    return total / weight.clamp_min(_TINY)


def _blurred(image: Tensor) -> Tensor:
    return F.avg_pool2d(image[None], _BLUR_PX, stride=1, padding=_BLUR_PX // 2, count_include_pad=False)[0]


_KEYS = 12  # frames whose identities are averaged


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
    inside = [crop.to_crop(px) for crop, px in zip(crops, keys, strict=True)]
    trust = [trust_inside(px, crop, *shape) for px, crop in zip(inside, crops, strict=True)]
    target = torch.from_numpy(np.stack(inside))
    fits = fit_batch(model, target, crops[0].camera, trust=torch.from_numpy(np.stack(trust)))
    return fits.alpha.mean(0).float()


class OnePerson:
    """One identity alpha [Ki], whose pose and expression are fitted to frames of a size (height, width)."""

    def __init__(self, model: MorphableModel, alpha: Tensor, size_px: tuple[int, int], crop_px: int) -> None:
        self._alpha, self._size_px, self._crop_px = alpha, size_px, crop_px
        mean = model.vertices(alpha[None], torch.zeros(1, len(model.expression)))[0]
        self._name = model.name
        self._model = replace(model, name="one person", mean=mean, identity=model.identity[:0])

    def fit(self, landmarks_px: np.ndarray) -> FaceFit:
        """Fit pose and expression to landmarks [68, 2] of a frame."""
        crop = from_landmarks(landmarks_px, self._crop_px)
        inside = crop.to_crop(landmarks_px)
        fit = fit_landmarks(self._model, inside, crop, trust=trust_inside(inside, crop, *self._size_px))
        return replace(fit, model=self._name, alpha=self._alpha)


KEY_FRAMES = 5  # from which the light is estimated
_UNIT = ("normals", "strands")  # maps of unit vectors


@dataclass(eq=False)
class _Observation:
    """Classes [C, h, w] that a frame shows alone, its small image, and the rest once it is asked for."""

    classes: Tensor
    small: Tensor
    fit: FaceFit | None = None
    segmentation: Segmentation | None = None
    views: list[tuple[SeenPerson, PortraitMaps]] | None = None


class SteadyShot:
    """A person through the frames of a shot, each steadied by those around it.

    What frames see is kept for those around the last one that was asked for: in order each is looked at once.
    What holds for the whole shot is found when it is first needed, and kept.

    Args:
        models: The face model and the networks.
        frames: Gives frames by number, scene-linear [H, W, 3], all of one size.
        sightings: The face in each of them.
        sides: Those of texture and crop.
        mattes: Gives the person's [H, W] by number, if given; black in frames without the person.
        white: Whose colours skin has under even white light; None: those of the networks.
    """

    def __init__(
        self,
        models: Models,
        frames: Callable[[int], np.ndarray],
        sightings: Sequence[Sighting | None],
        sides: Sides,
        mattes: Callable[[int], np.ndarray] | None = None,
        white: White | None = None,
    ) -> None:
        self._models, self._frames, self._mattes = models, frames, mattes
        self._sides, self._white = sides, white
        self._path = path_of(sightings)  # [N, 68, 2], NaN where the face is lost
        self._sighted = [frame for frame, seen in enumerate(sightings) if seen]
        self._shown = frozenset(np.flatnonzero(np.isfinite(self._path).all((1, 2))).tolist())
        self._near: dict[int, _Observation] = {}

    def window(self, frame: int, portrait: bool = True) -> SteadyFrame:
        """A frame as those around it steady it; `portrait` says whether the portrait field is wanted."""
        light, balance = self.light, self._balance  # from other frames, before those around this one
        self._keep_near(frame)
        views = self._steady_views(frame) if portrait and self._shows(frame) else ()
        head = self._key_heads.get(frame) or self._head(frame)
        return SteadyFrame(head, light, self._segmentation(frame), views, balance)

    def segmentation(self, frame: int) -> Segmentation:
        """The person of a frame, from the classes of those around it."""
        self._keep_near(frame)
        return self._segmentation(frame)

    def landmarks_px(self, frame: int) -> np.ndarray:
        """Smoothed landmarks [68, 2] of a frame; raises InputError where the face is lost."""
        if frame not in self._shown:
            raise InputError(f"frame {frame}: the face is not seen in more frames than can be filled in")
        found: np.ndarray = self._path[frame]
        return found

    @cached_property
    def key_frames(self) -> list[int]:
        """Frames that stand for the shot, evenly spread over those in which the face was sighted.

        Those whose given matte is black are left out.
        """
        if not self._sighted:
            raise InputError("no frame shows a face")
        keys = spread_over(self._sighted, KEY_FRAMES)
        return [frame for frame in keys if self._shows(frame)] or keys

    @property
    def middle(self) -> int:
        """The key frame of the middle."""
        return self.key_frames[len(self.key_frames) // 2]

    @property
    def other_heads(self) -> list[Head]:
        """The heads of the other key frames."""
        return [head for frame, head in self._key_heads.items() if frame != self.middle]

    @cached_property
    def light(self) -> RigLight:
        """The light of the shot, from key frames together."""
        return light_of_frames(self._models, [head.face for head in self._key_heads.values()])

    @cached_property
    def _balance(self) -> Balance | None:
        """The balance of the shot, from key frames together."""
        if self._white is None:
            return None
        faces = [head.face for head in self._key_heads.values()]
        evens = [source_light(self._models, one, self.light).even for one in faces]
        return balance_of(self._white, list(zip(faces, evens, strict=True)))

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
        places = [self._path[frame] for frame in self._sighted]
        alpha = identity_of(self._models.face, places, size_px, crop_px)
        return OnePerson(self._models.face, alpha, size_px, crop_px)

    @cached_property
    def _wide(self) -> tuple[float, float, float] | None:
        """Place and side of the wider square in the middle of the shot, in sides of the head's square."""
        fit = self._fit(self.middle)
        head = portrait_square(fit.crop.to_photo(fit.landmarks_px.numpy()))
        wide = wider_square(head, self._segmentation(self.middle).matte)
        if wide is None:
            return None
        offsets = wide.x0_px - head.x0_px, wide.y0_px - head.y0_px
        return offsets[0] / head.side_px, offsets[1] / head.side_px, wide.side_px / head.side_px

    def _shows(self, frame: int) -> bool:
        return self._mattes is None or bool(self._mattes(frame).any())

    def _around(self, frame: int) -> list[int]:
        """The frame and its neighbours that show the face, without those beyond a frame where it is lost."""
        found = [frame]
        for step in (-1, 1):
            at = frame + step
            while abs(at - frame) <= MAPS_REACH and 0 <= at < len(self._path) and at in self._shown:
                found.append(at)
                at += step
        return sorted(found)

    def _keep_near(self, frame: int) -> None:
        """Let go what only frames far from this one need; its neighbours need their own neighbours."""
        reach = 2 * MAPS_REACH
        self._near = {one: seen for one, seen in self._near.items() if abs(one - frame) <= reach}

    def _seen(self, frame: int) -> _Observation:
        """Look at a frame alone, once."""
        if frame not in self._near:
            people, landmarks_px = self._models.networks.people, self.landmarks_px(frame)
            image = to_display(self._frames(frame))
            small = small_image(image)
            if self._mattes is not None:
                classes = parsed(people.parsing, image, landmarks_px, small)
            else:
                classes = seen_classes(people, image, landmarks_px, small)
            self._near[frame] = _Observation(classes, small)
        return self._near[frame]

    def _segmentation(self, frame: int) -> Segmentation:
        seen = self._seen(frame)
        if seen.segmentation is None:
            around = self._around(frame)
            near = [self._seen(one) for one in around]
            mean = steadied([one.classes for one in near], [one.small for one in near], around.index(frame))
            mean = mean / mean.sum(0).clamp_min(1e-6)
            if self._mattes is not None:
                seen.segmentation = within_matte(mean, self._mattes(frame))
            else:
                image = to_display(self._frames(frame))
                seen.segmentation = segmentation_of(mean, image, self.landmarks_px(frame))
        return seen.segmentation

    def _fit(self, frame: int) -> FaceFit:
        seen = self._seen(frame)
        if seen.fit is None:
            seen.fit = self._person.fit(self.landmarks_px(frame))
        return seen.fit

    def _head(self, frame: int) -> Head:
        """The head of a frame, without what covers its skin."""
        model, fit, photo = self._models.face, self._fit(frame), self._frames(frame)
        cropped = fit.crop.apply(photo)
        head = Head(cropped, fit, unwrap_face(model, fit, cropped, self._sides.texture, photo.shape))
        height, width = photo.shape[:2]
        classes = self._segmentation(frame).classes
        try:
            return head.without(model, uncovered_in(classes, (height, width), fit.crop))
        except InputError:  # all of it is covered: in this frame something passes before it
            return head

    def _views(self, frame: int) -> list[tuple[SeenPerson, PortraitMaps]]:
        """The person around the head and, if it needs it, in a wider square that follows the head."""
        seen = self._seen(frame)
        if seen.views is None:
            networks, photo = self._models.networks, self._frames(frame)
            fit, segmentation = self._fit(frame), self._segmentation(frame)
            person = look_at_person(networks.people, self._models.face, photo, fit, segmentation=segmentation)
            people = [person]
            if self._wide is not None:
                head = person.square
                x, y, side = (part * head.side_px for part in self._wide)
                people.append(person.within(Crop(head.x0_px + x, head.y0_px + y, side, head.size_px), photo))
            seen.views = [(one, maps_of(networks.portrait, one)) for one in people]
        return seen.views

    def _steady_views(self, frame: int) -> tuple[tuple[SeenPerson, PortraitMaps], ...]:
        """The person of a frame, and maps averaged with its neighbours', since squares follow the head."""
        around = [one for one in self._around(frame) if self._shows(one)]
        views = zip(*(self._views(one) for one in around), strict=True)
        middle = around.index(frame)
        return tuple((near[middle][0], _steadied_maps(near, middle)) for near in views)


def _steadied_maps(near: Sequence[tuple[SeenPerson, PortraitMaps]], middle: int) -> PortraitMaps:
    """Maps of the middle one of some frames, averaged with the others'."""
    images = [_encoded(person) for person, _ in near]
    halves = [F.avg_pool2d(image[None], 2)[0] for image in images]
    means: dict[str, Tensor] = {}
    for name in PortraitMaps._fields:
        if name == "albedo":
            continue
        layers = [getattr(maps, name)[0] for _, maps in near]
        if name == "gain":
            layers = [layer.log() for layer in layers]
        found = steadied(layers, images if layers[0].shape[-1] == images[0].shape[-1] else halves, middle)
        if name in _UNIT:
            found = F.normalize(found, dim=0)
        means[name] = (found.exp() if name == "gain" else found)[None]
    person = near[middle][0]
    albedo = person.exposed[None] * means["gain"] + means["bias"]
    return PortraitMaps(albedo=albedo, **means)


def _encoded(person: SeenPerson) -> Tensor:
    """The person's image [3, S, S] for comparison, display-encoded in 0..1; the skin is about middle grey."""
    return (person.exposed / 2).clamp(0, 1).pow(1 / 2.2)
