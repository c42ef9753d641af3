"""Cuts of a film, one face followed through the frames of a shot, and smoothing over time.

A curve is smoothed by a local quadratic (Savitzky and Golay, *Smoothing and differentiation of data by
simplified least squares procedures*, 1964), with weights, so that frames that are missing or unsure count for
nothing or little. It has no delay, and keeps a movement that is a parabola over the window. Maps are smoothed
by a bilateral filter along time (Tomasi and Manduchi, *Bilateral filtering for gray and color images*, 1998):
a pixel takes part in the mean as far as the image there looks as it does in the frame itself.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cache, cached_property, lru_cache
from itertools import pairwise

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from facerf_cli.errors import InputError
from facerf_cli.face.crop import Crop, from_landmarks
from facerf_cli.face.fit import FaceFit, fit_batch, fit_landmarks, trust_inside
from facerf_cli.face.head import FaceTexture, Head, unwrap_face
from facerf_cli.face.landmarks import to_display
from facerf_cli.face.morphable import MorphableModel
from facerf_cli.light.sphere import RigLight
from facerf_cli.network.portrait import PortraitMaps
from facerf_cli.network.stored_graph import PeopleNetworks
from facerf_cli.portrait.find import Face, choose_face, detect_faces, face_near
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
from facerf_cli.relighting.portrait_field import SteadyFrame, maps_of
from facerf_cli.relighting.source_light import light_of_frames, source_light
from facerf_cli.relighting.white import Balance

_ROWS, _COLUMNS = 12, 16  # of a thumbnail
_LEAST = 0.05  # change at a cut, display values in 0..1
_TIMES = 3.0  # of the largest change around it
_REACH = 3  # frames on each side


class CutFinder:
    """Cuts of a film of `count` frames; `show` gives a frame, sRGB uint8 [H, W, 3], by number."""

    def __init__(self, count: int, show: Callable[[int], np.ndarray]) -> None:
        self._count = count
        self._small = lru_cache(2)(lambda frame: thumbnail(show(frame)))
        self._change = lru_cache(4 * _REACH)(self._changed)

    def is_cut(self, frame: int) -> bool:
        """Tell if a new shot begins with a frame."""
        if frame == 0:
            return False
        around = range(max(1, frame - _REACH), min(self._count, frame + _REACH + 1))
        changes = {one: self._change(one) for one in around}
        return stands_out(changes.pop(frame), list(changes.values()))

    def _changed(self, frame: int) -> float:
        before, now = self._small(frame - 1), self._small(frame)
        return float(np.abs(now - before).mean())


def stands_out(change: float, around: Sequence[float]) -> bool:
    """Tell if a change is that of a cut, among the changes of the frames around it."""
    return change > max(_LEAST, _TIMES * max(around, default=0.0))


def thumbnail(image_srgb: np.ndarray) -> np.ndarray:
    """Means [_ROWS, _COLUMNS, 3] in 0..1 of parts of an image, uint8 [H, W, 3]."""
    pixels = torch.from_numpy(image_srgb).permute(2, 0, 1)[None].float() / 255
    return F.adaptive_avg_pool2d(pixels, (_ROWS, _COLUMNS))[0].permute(1, 2, 0).numpy()


def takes(count: int, cuts: Sequence[int]) -> list[range]:
    """The frames of each take of a film of `count` frames, in order; cuts are first frames of takes."""
    edges = [0, *cuts, count]
    return [range(first, end) for first, end in pairwise(edges)]


REACH = 5  # frames on each side of a curve's window
_FULL = 4  # frames with weight from which on a window has a quadratic; with fewer it is a line or a mean
MAPS_REACH = 2  # frames on each side of a map's window
_ALIKE = 0.03  # difference of images, in 0..1, at which a neighbour's weight falls to 0.6
_BLUR_PX = 3  # side of the square over which images are compared, against their noise
_TINY = 1e-9


def smoothed(values: np.ndarray, weights: np.ndarray, reach: int = REACH) -> np.ndarray:
    """Smooth curves [N, ...] with weights [N] >= 0 by local quadratics; NaN where a window has no weight.

    The window has `reach` frames on each side, under a tricube (Cleveland, *Robust locally weighted
    regression and smoothing scatterplots*, 1979).
    """
    flat = values.reshape(len(values), -1).astype(np.float64)
    result = np.full_like(flat, np.nan)
    for frame in range(len(flat)):
        first, last = max(0, frame - reach), min(len(flat), frame + reach + 1)
        at = np.arange(first, last) - frame
        weight = weights[first:last] * (1 - (np.abs(at) / (reach + 1)) ** 3) ** 3
        used = weight > 0
        if used.any():
            result[frame] = _local(at[used], flat[first:last][used], weight[used])
    return result.reshape(values.shape)


def _local(at: np.ndarray, values: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """The value [C] at 0 of the polynomial that fits values [M, C] at times [M] best."""
    order = 2 if len(at) >= _FULL else min(1, len(at) - 1)
    columns = np.vander(at, order + 1, increasing=True) * np.sqrt(weight)[:, None]
    return np.asarray(np.linalg.lstsq(columns, values * np.sqrt(weight)[:, None], rcond=None)[0][0])


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


LONGEST_GAP = 12  # frames without the face that are bridged: half a second at 24 frames a second
_FURTHEST = 1.5  # extents of its landmarks that a face may move while it is lost
_SIZES = (0.6, 1.7)  # range of the change of its size meanwhile
_BRIDGE_WEIGHT = 0.05  # of a frame in a gap


@dataclass(frozen=True, eq=False)
class Sighting:
    """A face in one frame: landmarks [68, 2] in pixels, and its median expected error, in their extent."""

    landmarks_px: np.ndarray
    error: float


class Follower:
    """Finds the same face in frame after frame; `last` are its landmarks [68, 2] where it was seen last."""

    def __init__(
        self,
        people: PeopleNetworks,
        which: str,
        last: np.ndarray | None = None,
    ) -> None:
        self._people = people
        self._which, self._last = which, last

    def see(self, image_srgb: np.ndarray) -> Sighting | None:
        """Find the face in the next frame, sRGB uint8 [H, W, 3]; None where it is not seen.

        Near the place of the frame before, else in the whole frame: the one nearest to that place, of about
        its size. The first face is the one that `which` chooses: largest, or an index from the left.
        """
        face: Face | None = None
        if self._last is not None:
            face = face_near(self._people, image_srgb, self._last)
            if face is not None and not _may_be(face, self._last):
                face = None
        if face is None:
            face = self._searched(image_srgb)
        if face is None:
            return None
        self._last = face.landmarks_px
        error = face.view.relative_error if face.view else 0.0
        return Sighting(face.landmarks_px, error)

    def _searched(self, image_srgb: np.ndarray) -> Face | None:
        last = self._last
        everyone = last is not None or self._which != "largest"
        faces = detect_faces(self._people, image_srgb, everyone)
        if last is None:
            few = self._which.isdecimal() and int(self._which) >= len(faces)
            return None if few or not faces else choose_face(faces, self._which, "frame")[0]
        near = [face for face in faces if _may_be(face, last)]
        return min(near, key=lambda face: _apart_px(face.landmarks_px, last)) if near else None


def _may_be(face: Face, last: np.ndarray) -> bool:
    """Tell if a face can be the one that was at landmarks [68, 2]."""
    before, now = _extent_px(last), _extent_px(face.landmarks_px)
    low, high = _SIZES
    return low < now / before < high and _apart_px(face.landmarks_px, last) < _FURTHEST * before


def _apart_px(one: np.ndarray, other: np.ndarray) -> float:
    return float(np.linalg.norm(one.mean(0) - other.mean(0)))


def _extent_px(landmarks_px: np.ndarray) -> float:
    return max(float(np.ptp(landmarks_px, axis=0).max()), 1.0)


def path_of(sightings: Sequence[Sighting | None]) -> np.ndarray:
    """Smoothed landmarks [N, 68, 2] of a shot; NaN where the face is lost, but for gaps that are bridged."""
    path = np.full((len(sightings), 68, 2), np.nan)
    weights = np.zeros(len(sightings))
    for frame, seen in enumerate(sightings):
        if seen is not None:
            path[frame], weights[frame] = seen.landmarks_px, 1.0
    for first, last in gaps(sightings):
        if first > 0 and last + 1 < len(sightings) and last - first < LONGEST_GAP:
            share = (np.arange(first, last + 1) - first + 1)[:, None, None] / (last - first + 2)
            path[first : last + 1] = path[first - 1] + share * (path[last + 1] - path[first - 1])
            weights[first : last + 1] = _BRIDGE_WEIGHT
    kept = weights > 0
    found = smoothed(np.where(kept[:, None, None], path, 0), weights)
    return np.where(kept[:, None, None], found, np.nan)


def gaps(sightings: Sequence[Sighting | None]) -> Iterator[tuple[int, int]]:
    """First and last frames of each run of frames without the face."""
    first = None
    for frame, seen in enumerate([*sightings, Sighting(np.zeros((68, 2)), 0.0)]):
        if seen is None and first is None:
            first = frame
        elif seen is not None and first is not None:
            yield first, frame - 1
            first = None


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


def fit_frame(
    model: MorphableModel, alpha: Tensor, landmarks_px: np.ndarray, shape: tuple[int, int], crop_px: int
) -> FaceFit:
    """Fit pose and expression of a person alpha [Ki] to the landmarks [68, 2] of a frame of shape [H, W]."""
    crop = from_landmarks(landmarks_px, crop_px)
    inside = crop.to_crop(landmarks_px)
    person = _of_one_person(model, tuple(alpha.tolist()))
    fit = fit_landmarks(person, inside, crop, trust=trust_inside(inside, crop, *shape))
    return replace(fit, model=model.name, alpha=alpha)


@cache
def _of_one_person(model: MorphableModel, alpha: tuple[float, ...]) -> MorphableModel:
    """The face model with one identity only; kept, since the fit keeps what it derives from a model."""
    mean = model.vertices(torch.tensor([alpha]), torch.zeros(1, len(model.expression)))[0]
    return replace(model, name=f"{model.name}-person", mean=mean, identity=model.identity[:0], head=None)


KEY_FRAMES = 5  # from which the light is estimated
_KEPT = 2 * (2 * MAPS_REACH + 1)  # frames of which something is kept
_UNIT = ("normals", "strands")  # maps of unit vectors


class ShotView:
    """A person through a shot, whose face was sighted in some frames.

    `read` gives frames [H, W, 3], scene-linear, by number; `given`, if not None, the person's matte [H, W],
    which is black in frames without the person.
    """

    def __init__(
        self,
        models: Models,
        sides: Sides,
        read: Callable[[int], np.ndarray],
        sightings: Sequence[Sighting | None],
        given: Callable[[int], np.ndarray] | None = None,
    ) -> None:
        self._models, self._sides, self._read, self._given = models, sides, read, given
        self._path = path_of(sightings)  # [N, 68, 2], NaN where the face is lost
        self._sighted = [frame for frame, seen in enumerate(sightings) if seen]
        self._shown = frozenset(np.flatnonzero(np.isfinite(self._path).all((1, 2))).tolist())
        self._display = lru_cache(2)(lambda frame: to_display(read(frame)))
        self._classes = lru_cache(_KEPT)(self._look)
        self.head: Callable[[int], Head] = lru_cache(_KEPT)(self._seen_head)  # without what covers its skin
        self.segmentation: Callable[[int], Segmentation] = lru_cache(_KEPT)(self._segmentation)
        self._balance = lru_cache(1)(self._balance_of)
        self._people = lru_cache(_KEPT)(self._seen_people)
        self._maps = lru_cache(_KEPT)(
            lambda frame: [maps_of(models.networks.portrait, person) for person in self._people(frame)]
        )

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

    def steady(self, frame: int, portrait: bool = True, white: White | None = None) -> SteadyFrame:
        """A frame as those around it steady it; `portrait` says whether the portrait field is wanted."""
        views: tuple[tuple[SeenPerson, PortraitMaps], ...] = ()
        if portrait and self._shows(frame):
            views = tuple(zip(self._people(frame), self._steady_maps(frame), strict=True))
        balance = None if white is None else self._balance(white)
        return SteadyFrame(self.light, self.segmentation(frame), views, balance)

    def _shows(self, frame: int) -> bool:
        return self._given is None or bool(self._given(frame).any())

    @cached_property
    def light(self) -> RigLight:
        """The light of the shot, from key frames together."""
        return light_of_frames(self._models, self._key_faces)

    def _balance_of(self, white: White) -> Balance:
        """The balance of the shot, from key frames together."""
        faces = self._key_faces
        return balance_of(white, [(one, source_light(self._models, one, self.light).even) for one in faces])

    @property
    def _key_faces(self) -> list[FaceTexture]:
        return [self.head(frame).face for frame in self.key_frames]

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
        height, width = self._read(frame).shape[:2]
        size = height, width
        return fit_frame(self._models.face, self._identity, landmarks_px, size, self._sides.crop_px)

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
        people, landmarks_px = self._models.networks.people, self.landmarks_px(frame)
        if self._given is not None:
            return parsed(people.parsing, image, landmarks_px, small), small
        return seen_classes(people, image, landmarks_px, small), small

    def _segmentation(self, frame: int) -> Segmentation:
        around = self._around(frame)
        classes, images = zip(*(self._classes(one) for one in around), strict=True)
        own = around.index(frame)
        mean = steadied(classes, images, own)
        mean = mean / mean.sum(0).clamp_min(1e-6)
        if self._given is not None:
            return within_matte(mean, self._given(frame))
        return segmentation_of(mean, self._display(frame), self.landmarks_px(frame))

    @cached_property
    def _wide(self) -> tuple[float, float, float] | None:
        """Place and side of the wider square in the middle of the shot, in sides of the head's square."""
        frame = self.middle_first[0]
        fit = self._fit(frame)
        head = portrait_square(fit.crop.to_photo(fit.landmarks_px.numpy()))
        wide = wider_square(head, self.segmentation(frame).matte)
        if wide is None:
            return None
        offsets = wide.x0_px - head.x0_px, wide.y0_px - head.y0_px
        return offsets[0] / head.side_px, offsets[1] / head.side_px, wide.side_px / head.side_px

    def _seen_people(self, frame: int) -> list[SeenPerson]:
        """The person of a frame around the head and, if it needs it, in a wider one that follows the head."""
        fit, segmentation = self._fit(frame), self.segmentation(frame)
        people, model, photo = self._models.networks.people, self._models.face, self._read(frame)
        person = look_at_person(people, model, photo, fit, segmentation=segmentation)
        if self._wide is None:
            return [person]
        x, y, side = (part * person.square.side_px for part in self._wide)
        head = person.square
        return [person, person.within(Crop(head.x0_px + x, head.y0_px + y, side, head.size_px), photo)]

    def _steady_maps(self, frame: int) -> list[PortraitMaps]:
        """Maps of a frame, averaged with its neighbours' in the squares, which follow the head."""
        around = [one for one in self._around(frame) if self._shows(one)]
        people, maps = [self._people(one) for one in around], [self._maps(one) for one in around]
        middle = around.index(frame)
        return [
            _steadied_maps([frames[view] for frames in maps], [frames[view] for frames in people], middle)
            for view in range(len(people[0]))
        ]


def _steadied_maps(maps: Sequence[PortraitMaps], people: Sequence[SeenPerson], middle: int) -> PortraitMaps:
    """Maps of the middle one of some frames, averaged with the others'."""
    images = [_encoded(person) for person in people]
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
    person = people[middle]
    albedo = person.image[None] / person.exposure * means["gain"] + means["bias"]
    return PortraitMaps(albedo=albedo, **means)


def _encoded(person: SeenPerson) -> Tensor:
    """The person's image [3, S, S] for comparison, display-encoded in 0..1; the skin is about middle grey."""
    return (person.image / person.exposure / 2).clamp(0, 1).pow(1 / 2.2)
