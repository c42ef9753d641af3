"""Classes and matte of a person over the whole frame of a photo, as layers.

The Parsing Network looks at the whole body and, for detail, at head and chest and at squares of several
sizes around the head.
"""

from dataclasses import dataclass, replace
from functools import cached_property, partial
from itertools import pairwise

import numpy as np
import torch
import torch.nn.functional as F
from scipy.ndimage import distance_transform_edt, label
from scipy.spatial import cKDTree
from skimage.color import rgb2lab
from torch import Tensor

from facerf_cli.image.strips import Band, enlarged
from facerf_cli.network.parsing import ParsingNetwork
from facerf_cli.portrait.classes import CLASSES, MORE_LANDMARKS, class_index
from facerf_cli.portrait.matte import refine_matte, shrunk
from facerf_cli.portrait.parse import Square, SquareView, look
from facerf_cli.raster.camera import PIXEL_CENTRE

# Sides of the squares around head, head and chest, and body, in extents of the landmarks, and how far their
# centres lie above the middle of the landmarks. Views of the head are averaged; smaller ones, which show
# more, weigh more, by an inverse power of their sides.
_NEAR_SIDES, _NEAR_ABOVE = (1.6, 2.2, 3.2), 0.1
_CHEST_SIDES, _CHEST_ABOVE = 4.0, -0.5
_BODY_SIDES, _BODY_ABOVE = 8.0, -1.6
_STEEPNESS = 4.0  # the power
_FEATHER = 0.08  # border of a near square where it gives way to larger ones, in its sides
_HAIR = 1.3  # hair is so many times as likely as the network says, which takes thin hair for the skin below
# Shares of the person below which a pixel is background, and above which it is whole; of all, and of clothes.
_PERSON, _CLOTH = (0.5, 0.8), (0.3, 0.7)
_LEAST_SHARE = 1e-3  # of a pixel, that every class of the person may have
_SMALL_PX = 384  # longest side at which classes are joined
# Lengths in extents of the landmarks: the line from the middle of the face down to the chest, and how far
# from it all of the person counts as joined; half the width of a bridge that joins nobody; how far around the
# middle of the face, and around the body, what is seen of the person is kept. How far below the middle of the
# face, and how far beside it, the person's chest has no holes; how far around them clothes are whole.
_CHEST_BELOW, _WITHIN, _BRIDGE, _OF_HEAD, _OF_BODY = 1.5, 0.4, 0.06, 1.2, 0.2
_CHEST_FROM, _CHEST_BESIDE, _RIM = 1.0, 1.0, 0.08
# Of ears, which the network's own landmarks place.
_EAR_LIFT = 1.25  # logarithm of the largest factor of the odds
_EAR_WIDTH = 0.045  # standard deviation of the distance from the line, in extents of the landmarks
_EAR_REACH = 3.0  # in these, beyond which nothing changes
_EAR_OTHERS = [class_index(name) for name in ("background", "skin", "hair", "neck")]
_EAR_LINES = [
    [68 + MORE_LANDMARKS.index(f"{side} ear {part}") for part in ("top", "back", "lobe")]
    for side in ("left", "right")
]
# Of the outline: shares of the person from which on, well inside it, a pixel is sure, and up to which it is
# background.
_SURE_PERSON, _SURE_BACKGROUND = 0.9, 0.1
_WELL_INSIDE = 0.1  # how far inside the person, in extents of the landmarks
_NEAREST, _APART = 4, 4  # sure pixels that a pixel is compared with, of every fourth one
_COLOURS_PER_EXTENT = 0.1  # difference of colour, in Lab / 100, that counts as one of places by an extent
_COLOUR_SPREAD = 0.06  # of the colours of one thing, in Lab / 100
_MOST_LOGIT, _LEAST_SIDE = 3.0, 0.02  # of the colours, and least share of either side in the network's


@dataclass(frozen=True, eq=False)
class Segmentation:
    """Shares [C, h, w] of the classes at a small size, and the matte [H, W] at the photo's."""

    classes: Tensor
    matte: np.ndarray

    def cut(self, alpha: np.ndarray | None) -> "Segmentation":
        """The person without what the photo's own alpha [H, W] leaves out; None leaves out nothing."""
        return self if alpha is None else replace(self, matte=self.matte * alpha)

    def layer(self, name: str, rows: slice = slice(None)) -> np.ndarray:
        """Share [h, W] float32 of a class; those of all classes but the background sum to the matte."""
        share = self._shares[class_index(name) - 1][None].numpy()
        return np.asarray(enlarged(share, self.matte.shape, rows)[0] * self.matte[rows])

    @cached_property
    def _shares(self) -> Tensor:
        """Shares [C - 1, h, w] of the person; where nothing is seen of it, those of the whole person."""
        person = self.classes[1:]
        whole = person.sum((1, 2), keepdim=True)
        person = person + _LEAST_SHARE * whole / whole.sum().clamp_min(1e-6)
        return person / person.sum(0).clamp_min(1e-6)

    def layers(self) -> dict[str, Band]:
        """All classes of the person, by rows, by the names that they have in an EXR file."""
        return {f"class.{name}": partial(self.layer, name) for name in CLASSES[1:]}


def segment(parsing: ParsingNetwork, image_srgb: np.ndarray, landmarks_px: np.ndarray) -> Segmentation:
    """Segment the person with landmarks [68, 2] in an sRGB uint8 image [H, W, 3]."""
    small = small_image(image_srgb)
    return segmentation_of(seen_classes(parsing, image_srgb, landmarks_px, small), image_srgb, small)


def seen_classes(
    parsing: ParsingNetwork, image_srgb: np.ndarray, landmarks_px: np.ndarray, small: Tensor
) -> Tensor:
    """Shares [C, h, w] of the classes, which sum to 1; `small` is the `small_image`. See `segment`."""
    height, width = image_srgb.shape[:2]
    body = _within(Square.around(landmarks_px, _BODY_SIDES, _BODY_ABOVE), height, width)
    chest = Square.around(landmarks_px, _CHEST_SIDES, _CHEST_ABOVE)
    near = [Square.around(landmarks_px, sides, _NEAR_ABOVE) for sides in _NEAR_SIDES]
    size = (small.shape[1], small.shape[2])
    views = look(parsing, image_srgb, [body, chest, *near])
    (wide, inside), (middle, feather), *close = (_over_photo(one, size, image_srgb.shape) for one in views)
    classes = torch.lerp(torch.where(inside > 0, wide, _only_background()), middle, feather)
    mean, weight, share = (torch.zeros(count, *size) for count in (len(CLASSES), 1, 1))
    for (one, feather), sides in zip(close, _NEAR_SIDES, strict=True):
        weighed = feather * sides**-_STEEPNESS
        mean.addcmul_(one, weighed)
        weight += weighed
        share = torch.maximum(share, feather)
    classes.lerp_(mean / weight.clamp_min(1e-6), share)
    places_px = _places(size, image_srgb.shape)
    classes = with_ears(_with_likelier_hair(classes), views[2], places_px)
    classes = _of_one_person(classes, landmarks_px, places_px)
    extent_px = max(1.0, Square.around(landmarks_px, 1).side_px * size[1] / width)
    classes = with_outline(classes / classes.sum(0).clamp_min(1e-6), small, extent_px)
    # again, since colours may cut off what was joined
    return _decided(_of_one_person(classes, landmarks_px, places_px))


def segmentation_of(classes: Tensor, image_srgb: np.ndarray, small: Tensor) -> Segmentation:
    """The segmentation of an image [H, W, 3] by its classes [C, h, w], whose matte follows its edges.

    `small` is its `small_image`.
    """
    guide = small.permute(1, 2, 0).numpy()
    return Segmentation(classes, refine_matte(1 - classes[0].numpy(), guide, image_srgb))


def small_image(image_srgb: np.ndarray) -> Tensor:
    """An sRGB uint8 image at the size of its classes [3, h, w], in 0..1."""
    small = shrunk(image_srgb, _small_size(*image_srgb.shape[:2])) / np.float32(255)
    return torch.from_numpy(small).permute(2, 0, 1)


def _small_size(height: int, width: int) -> tuple[int, int]:
    scale = min(1.0, _SMALL_PX / max(height, width))
    return max(1, round(height * scale)), max(1, round(width * scale))


def _within(square: Square, height: int, width: int) -> Square:
    """The square moved, and made smaller where it must be, to show little of what lies beyond the photo."""
    side_px = min(square.side_px, float(max(height, width)))
    x_px, y_px = (
        min(max(at, side_px / 2), length - side_px / 2) if length > side_px else length / 2
        for at, length in ((square.x_px, width), (square.y_px, height))
    )
    return Square(x_px, y_px, side_px)


def _places(size: tuple[int, int], shape: tuple[int, ...]) -> np.ndarray:
    """Centres [h, w, 2] of the pixels of a small image, in the photo's pixels."""
    y = (np.arange(size[0]) + PIXEL_CENTRE) * shape[0] / size[0]
    x = (np.arange(size[1]) + PIXEL_CENTRE) * shape[1] / size[1]
    return np.stack(np.meshgrid(x, y), -1)


def _over_photo(view: SquareView, size: tuple[int, int], shape: tuple[int, ...]) -> tuple[Tensor, Tensor]:
    """Classes [C, h, w] of an upright square over a small image of the whole photo, and their weight [h, w].

    The weight is 1 well inside the square and falls to 0 at its border.
    """
    down, right = (
        ((torch.arange(count) + PIXEL_CENTRE) * length / count - middle) / view.square.side_px + 0.5
        for count, length, middle in zip(size, shape, (view.square.y_px, view.square.x_px), strict=False)
    )
    grid = torch.stack(torch.meshgrid(2 * right - 1, 2 * down - 1, indexing="xy"), -1)[None]
    classes = F.grid_sample(view.classes[None], grid, padding_mode="border", align_corners=False)[0]
    fall = [(torch.minimum(at, 1 - at) / _FEATHER).clamp(0, 1) for at in (down, right)]
    return classes, torch.minimum(fall[0][:, None], fall[1])


def _of_one_person(classes: Tensor, landmarks_px: np.ndarray, places_px: np.ndarray) -> Tensor:
    """Classes without what is not joined to face and chest, or by a thin bridge alone, and without holes.

    The pixels [h, w] of the classes lie at places [h, w, 2] in the photo.
    """
    face = Square.around(landmarks_px, 1)
    extent_px = max(face.side_px, 1e-6)
    away = (places_px - (face.x_px, face.y_px)) / extent_px
    pixel = float(np.ptp(places_px, axis=(0, 1)).max()) / max(1, max(classes.shape[1:]) - 1) / extent_px
    return _joined(_without_holes(classes, away, pixel), away, pixel)


def _without_holes(classes: Tensor, away: np.ndarray, pixel: float) -> Tensor:
    """Classes without background amid the chest, such as a badge; places `away` [h, w, 2], see `_joined`."""
    background = classes[0].numpy() >= 0.5
    parts, _ = label(np.pad(background, 1, constant_values=True))
    chest = (away[..., 1] > _CHEST_FROM) & (np.abs(away[..., 0]) < _CHEST_BESIDE)
    holes = background & (parts[1:-1, 1:-1] != parts[0, 0]) & chest
    if not holes.any():
        return classes
    whole = torch.from_numpy(distance_transform_edt(~holes) * pixel < _RIM)
    person = classes[1:] / classes[1:].sum(0).clamp_min(1e-6)
    return torch.where(whole, torch.cat([torch.zeros_like(classes[:1]), person]), classes)


def _joined(classes: Tensor, away: np.ndarray, pixel: float) -> Tensor:
    """Classes without what is not joined to face and chest.

    Places `away` [h, w, 2] from the middle of the face and the side of a pixel are in the landmarks' extents.
    """
    apart = np.linalg.norm(away - [0, 1] * away.clip(0, _CHEST_BELOW), axis=-1)  # from the head's axis
    person, middle = classes[0].numpy() < 0.5, apart < _WITHIN
    inner = depth_px(person) * pixel > _BRIDGE
    joined = joined_to(inner | (person & middle), middle)
    around = distance_transform_edt(~joined) * pixel if joined.any() else np.zeros_like(apart)
    kept = np.maximum(_falling(np.linalg.norm(away, axis=-1), _OF_HEAD), _falling(around, _OF_BODY))
    return torch.lerp(_only_background(), classes, torch.from_numpy(kept).float())


def _with_likelier_hair(classes: Tensor) -> Tensor:
    """Classes [C, h, w] with `_HAIR` times the hair, as a share of the same person."""
    person, hair = classes[1:].clone(), class_index("hair") - 1
    person[hair] *= _HAIR
    kept = classes[1:].sum(0) / person.sum(0).clamp_min(1e-6)
    return torch.cat([classes[:1], person * kept])


def _decided(classes: Tensor) -> Tensor:
    """Classes [C, h, w] with less doubt about the person; a haze of background around it is none of it.

    The network sees heads a little too wide, and is less sure of clothes far below them. Edges of hair are
    softened again by those of the photo.
    """
    person = 1 - classes[0]
    cloth = classes[class_index("garment")] / person.clamp_min(1e-6)
    low, high = (
        of_person + (of_cloth - of_person) * cloth
        for of_person, of_cloth in zip(_PERSON, _CLOTH, strict=True)
    )
    firm = ((person - low) / (high - low)).clamp(0, 1)
    return torch.cat([1 - firm[None], classes[1:] * (firm / person.clamp_min(1e-6))])


def _falling(distance: np.ndarray, most: float) -> np.ndarray:
    """1 up to a distance, 0 from one and a half times it on."""
    return (3 - 2 * distance / most).clip(0, 1)


def _only_background() -> Tensor:
    shares = torch.zeros(len(CLASSES), 1, 1)
    shares[0] = 1
    return shares


def with_ears(classes: Tensor, view: SquareView, places_px: np.ndarray) -> Tensor:
    """Classes [C, h, w] with likelier ears at pixels that lie at places [h, w, 2] in the photo.

    Ears are small, and get the benefit of the doubt near the line through the landmarks of top, back and
    lobe. Odds are multiplied, so that what the network is sure of (hair over the ears, a hat) stays. Shares
    move between ears and background, skin, hair and neck; others stay.
    """
    lifted, ears = classes.clone(), class_index("ears")
    other = classes[_EAR_OTHERS].sum(0)
    both = classes[ears] + other
    likelier = classes[ears] * torch.from_numpy(np.exp(_EAR_LIFT * _nearness(view, places_px))).float()
    lifted[ears] = both * likelier / (likelier + other).clamp_min(1e-9)
    lifted[_EAR_OTHERS] *= (both - lifted[ears]) / other.clamp_min(1e-9)
    return lifted


def _nearness(view: SquareView, places_px: np.ndarray) -> np.ndarray:
    """Nearness [h, w] in 0..1 of places [h, w, 2] to the lines of both ears."""
    near = np.zeros(places_px.shape[:2])
    width_px = _EAR_WIDTH * max(view.extent_px, 1.0)
    for line in (view.landmarks_px[ear] for ear in _EAR_LINES):
        low, high = line.min(0) - _EAR_REACH * width_px, line.max(0) + _EAR_REACH * width_px
        around = ((places_px > low) & (places_px < high)).all(-1)
        apart = np.min([_distance(places_px[around], *pair) for pair in pairwise(line)], 0)
        near[around] = np.maximum(near[around], np.exp(-0.5 * (apart / width_px) ** 2))
    return near


def _distance(places: np.ndarray, start: np.ndarray, end: np.ndarray) -> np.ndarray:
    """Distance [N] of places [N, 2] from the segment between two points [2]."""
    along = end - start
    share = (((places - start) @ along) / max(float(along @ along), 1e-9)).clip(0, 1)
    return np.asarray(np.linalg.norm(places - start - share[..., None] * along, axis=-1))


def with_outline(classes: Tensor, image: Tensor, extent_px: float) -> Tensor:
    """Classes [C, h, w] whose matte follows the colours of an sRGB image [3, h, w] in 0..1 near the outline.

    A tree's trunk next to a cheek may look like a part of the person to the network; its colours are like
    those of the background around. `extent_px` is the extent of the landmarks in the image's pixels. The
    network's logit of the person is added to
    that of the colours, whose distances to sure colours of both sides are taken as normally distributed.
    Colours add no islands.
    """
    person = 1 - classes[0].numpy()
    sure, background = depth_px(person > _SURE_PERSON) > _WELL_INSIDE * extent_px, person < _SURE_BACKGROUND
    unsure = ~(sure | background)
    y, x = np.mgrid[: person.shape[0], : person.shape[1]]
    compared = (x + y) % _APART == 0
    if not unsure.any() or min(np.sum(sure & compared), np.sum(background & compared)) < _NEAREST:
        return classes
    places = np.stack([x, y], -1) * (_COLOURS_PER_EXTENT / extent_px)
    features = np.concatenate([rgb2lab(image.permute(1, 2, 0).numpy()) / 100, places], -1)

    def squared_distance(known: np.ndarray) -> np.ndarray:
        tree = cKDTree(features[known & compared])
        nearest = tree.query(features[unsure], range(1, _NEAREST + 1), workers=-1)[0]
        return np.square(nearest).mean(1)

    colours = (squared_distance(background) - squared_distance(sure)) / (2 * _COLOUR_SPREAD**2)
    share = torch.from_numpy(person)
    logit = share.clamp(_LEAST_SIDE, 1 - _LEAST_SIDE).logit()
    logit[unsure] += torch.from_numpy(colours.clip(-_MOST_LOGIT, _MOST_LOGIT)).float()
    changed = torch.where(torch.from_numpy(unsure), logit.sigmoid(), share)
    found = changed.numpy() > 0.5
    islands = torch.from_numpy(found & ~joined_to(found, sure))
    changed = torch.where(islands, torch.minimum(changed, share), changed)
    return torch.cat([1 - changed[None], classes[1:] * (changed / share.clamp_min(1e-6))])


def depth_px(region: np.ndarray) -> np.ndarray:
    """Distance [h, w] of pixels of a region [h, w] from its border; beyond the image the region goes on."""
    return np.asarray(distance_transform_edt(np.pad(region, 1, "edge"))[1:-1, 1:-1])


def joined_to(region: np.ndarray, seeds: np.ndarray) -> np.ndarray:
    """Pixels [h, w] of those parts of a region [h, w] that hold a seed [h, w]."""
    parts, _ = label(region)
    return region & np.isin(parts, parts[seeds])
