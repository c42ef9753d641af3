"""Classes and matte of a person over the whole frame of a photo, as layers.

`matte.py` solves the matte; the Parsing Network classifies its pixels. The network processes the whole body
and, for detail, head and chest and squares of several sizes around the head.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise

import numpy as np
import torch
from scipy.ndimage import binary_dilation, distance_transform_edt, gaussian_gradient_magnitude, label
from torch import Tensor

from facerf_cli.face.head import OtherHead
from facerf_cli.image.colour import srgb_to_linear
from facerf_cli.image.strips import enlarged, fitted
from facerf_cli.network.parsing import ParsingNetwork
from facerf_cli.network.stored_graph import PeopleNetworks
from facerf_cli.portrait.confidence import matte_facts
from facerf_cli.portrait.find import find_meshes, first_squares
from facerf_cli.portrait.matte import HeadPlace, matte_of, person_among, shrunk, solid
from facerf_cli.portrait.parse import (
    CLASSES,
    LEAST_PRESENCE,
    MORE_LANDMARKS,
    Square,
    SquareView,
    class_index,
    look,
)
from facerf_cli.raster.camera import PIXEL_CENTRE

# Sides of the squares around head, head and chest, and body, in extents of the landmarks, and the distance of
# their centres above the middle of the landmarks. Views of the head are averaged; smaller ones, which show
# more detail, have larger weights: an inverse power of their sides.
_NEAR_SIDES, _NEAR_ABOVE = (1.6, 2.2, 3.2), 0.1
_CHEST_SIDES, _CHEST_ABOVE = 4.0, -0.5
_BODY_SIDES, _BODY_ABOVE = 8.0, -1.6
_STEEPNESS = 4.0  # the power
_FEATHER = 0.08  # border of a near square over which it blends into larger ones, in its sides
_LOOSE = [class_index(name) for name in ("hair", "beard", "glasses", "headwear")]  # not made solid
_HAIR = 1.3  # factor of the odds of hair, because the network classifies thin hair as the skin below
_LEAST_SHARE = 1e-3  # least fraction of a pixel for each class of the person
_SMALL_PX = 384  # longest side at which classes are combined
_CLASSLESS = 0.3  # least coverage from the Parsing Network; below it a pixel takes the nearest one's classes
# Ears, which are placed by the network's landmarks.
_EAR_LIFT = 1.25  # logarithm of the largest factor of the odds
_EAR_WIDTH = 0.045  # standard deviation of the distance from the line, in extents of the landmarks
_EAR_REACH = 3.0  # largest distance with an effect, in standard deviations
_EAR_OTHERS = [class_index(name) for name in ("background", "skin", "hair", "neck")]
_EAR_LINES = [
    [68 + MORE_LANDMARKS.index(f"{side} ear {part}") for part in ("top", "back", "lobe")]
    for side in ("left", "right")
]
_SKIN_CLASSES = [class_index(name) for name in ("skin", "neck", "hand")]
_FACE_CLASSES = [class_index(name) for name in ("skin", "neck", "ears", "lips", "beard")]
_HAND, _GARMENT = class_index("hand"), class_index("garment")
_MAYBE = 0.3  # least fraction of skin in a pixel that may be cloth
_CERTAIN, _SURE_BESIDE = 0.9, 0.8  # fractions of certain skin, in the face and beside a region
_FACE_REACH = 0.7  # largest distance of certain face skin from its middle, in heights of the head
_CLOTH_EDGE = 0.12  # change of log brightness per pixel at which regions end
_EDGE_PX = 3  # half the width of such an edge
_BLACK, _NOISE = 5e-4, 2e-3  # linear light that hides the chromaticity of the face, and of other regions
_DARK = 0.03  # sRGB value below which edges are noise
_MARGIN = 1.16  # factor by which a ratio of channels must lie outside the face's
_LEAST_PART, _TOUCHES = 0.005, 0.25  # fraction of the person, and of the outline that borders certain skin


@dataclass(frozen=True, eq=False)
class Segmentation:
    """Probabilities [C, h, w] of the classes at a small size, and the matte [H, W] at the photo's size.

    `facts` measure the reliability of the matte; a frame of a shot has none.
    """

    classes: Tensor
    matte: np.ndarray
    facts: Mapping[str, float] = field(default_factory=dict)

    def cut(self, alpha: np.ndarray | None) -> "Segmentation":
        """Multiply the matte by the photo's own alpha [H, W], if any."""
        return self if alpha is None else replace(self, matte=self.matte * alpha)

    def layer(self, name: str, rows: slice = slice(None)) -> np.ndarray:
        """Return the coverage [h, W] float32 of a class; classes of the person sum to the matte."""
        return self.layers(rows, [name])[f"class.{name}"]

    def layers(self, rows: slice, names: Sequence[str] = CLASSES[1:]) -> dict[str, np.ndarray]:
        """Return the coverage [h, W] of the person's classes in some rows, by layer name of an EXR.

        Pixels without a predicted class have the mean fractions of the whole person.
        """
        person = self.classes[1:]
        whole = person.sum((1, 2), keepdim=True)
        person = person + _LEAST_SHARE * whole / whole.sum().clamp_min(1e-6)
        fractions = (person / person.sum(0).clamp_min(1e-6)).numpy()
        return {
            f"class.{name}": np.asarray(
                enlarged(fractions[[class_index(name) - 1]], self.matte.shape, rows)[0] * self.matte[rows]
            )
            for name in names
        }


def segment(
    people: PeopleNetworks,
    image_srgb: np.ndarray,
    landmarks_px: np.ndarray,
    matte: np.ndarray | None = None,
    others: Sequence[OtherHead] | None = None,
) -> Segmentation:
    """Segment one person.

    Args:
        people: The networks that find and cut out people.
        image_srgb: uint8 [H, W, 3].
        landmarks_px: Landmarks of the person's face [68, 2].
        matte: The person's matte [H, W] from the user; None solves it.
        others: The photo's other heads; None detects them.
    """
    small = small_image(image_srgb)
    if matte is not None:
        segmentation = within_matte(parsed(people.parsing, image_srgb, landmarks_px, small), matte)
        head = _head(landmarks_px, image_srgb, small)
        return replace(segmentation, classes=with_cloth(segmentation.classes, small, head))
    classes, anybody, head = _classes_of_person(people, image_srgb, landmarks_px, small, others)
    segmentation = segmentation_of(classes, image_srgb, landmarks_px)
    at = _centres_px((small.shape[1], small.shape[2]), segmentation.matte.shape).astype(int)
    small_matte = segmentation.matte[at[..., 1], at[..., 0]]
    return replace(segmentation, facts=matte_facts(anybody, 1 - classes[0].numpy(), small_matte, head))


def predicted_classes(
    people: PeopleNetworks, image_srgb: np.ndarray, landmarks_px: np.ndarray, small: Tensor
) -> Tensor:
    """Return only the classes [C, h, w] of `segment`, which sum to 1; `small` is the `small_image`."""
    return _classes_of_person(people, image_srgb, landmarks_px, small)[0]


def _classes_of_person(
    people: PeopleNetworks,
    image_srgb: np.ndarray,
    landmarks_px: np.ndarray,
    small: Tensor,
    others: Sequence[OtherHead] | None = None,
) -> tuple[Tensor, np.ndarray, HeadPlace]:
    """Return the classes [C, h, w] of a person, the coverage [h, w] by all people, and the head."""
    classes = parsed(people.parsing, image_srgb, landmarks_px, small)
    head = _head(landmarks_px, image_srgb, small)
    others = list(_neighbours(people, image_srgb, landmarks_px)) if others is None else others
    around = [other.scaled(small.shape[2] / image_srgb.shape[1]) for other in others]
    small_rgb, person = small.permute(1, 2, 0).numpy(), 1 - classes[0].numpy()
    person, anybody = person_among(people, small_rgb, head, around, person)
    return with_cloth(_within_share(classes, person), small, head), anybody, head


def _head(landmarks_px: np.ndarray, image_srgb: np.ndarray, small: Tensor) -> HeadPlace:
    return HeadPlace.of(landmarks_px * (small.shape[2] / image_srgb.shape[1]))


def _neighbours(
    people: PeopleNetworks, image_srgb: np.ndarray, landmarks_px: np.ndarray
) -> Iterator[OtherHead]:
    """Yield the other heads in an image that the Parsing Network confirms."""
    middle, extent_px = landmarks_px.mean(0), np.ptp(landmarks_px, axis=0).max()
    for mesh in find_meshes(people, image_srgb, first_squares(image_srgb)):
        if np.linalg.norm(mesh.landmarks_px.mean(0) - middle) > extent_px / 2:
            (view,) = look(people.parsing, image_srgb, [mesh.square])
            if view.presence >= LEAST_PRESENCE:
                yield OtherHead(mesh.landmarks_px)


def segmentation_of(classes: Tensor, image_srgb: np.ndarray, landmarks_px: np.ndarray) -> Segmentation:
    """Solve the matte of a person with classes [C, h, w] and landmarks [68, 2] in an image [H, W, 3]."""
    matte = matte_of(1 - classes[0].numpy(), image_srgb, landmarks_px)
    return Segmentation(classes, solid(matte, classes[_LOOSE].sum(0).numpy()))


def within_matte(classes: Tensor, matte: np.ndarray) -> Segmentation:
    """Segment the person in a matte [H, W]; pixels without predicted classes [C, h, w] are completed."""
    share = shrunk(matte, (classes.shape[1], classes.shape[2]))
    return Segmentation(_within_share(classes, share), matte)


def parsed(
    parsing: ParsingNetwork, image_srgb: np.ndarray, landmarks_px: np.ndarray, small: Tensor
) -> Tensor:
    """Combine the Parsing Network's views of a person into classes [C, h, w]."""
    height, width = image_srgb.shape[:2]
    body = _within(Square.around(landmarks_px, _BODY_SIDES, _BODY_ABOVE), height, width)
    chest = Square.around(landmarks_px, _CHEST_SIDES, _CHEST_ABOVE)
    near = [Square.around(landmarks_px, sides, _NEAR_ABOVE) for sides in _NEAR_SIDES]
    size = (small.shape[1], small.shape[2])
    views = look(parsing, image_srgb, [body, chest, *near])
    background = torch.eye(len(CLASSES))[0, :, None, None]
    (wide, inside), (middle, feather), *close = (
        view.square.laid_over(view.classes, size, image_srgb.shape, _FEATHER) for view in views
    )
    classes = torch.lerp(torch.where(inside > 0, wide, background), middle, feather)
    mean, weight, share = (torch.zeros(count, *size) for count in (len(CLASSES), 1, 1))
    for (view_classes, feather), sides in zip(close, _NEAR_SIDES, strict=True):
        view_weight = feather * sides**-_STEEPNESS
        mean.addcmul_(view_classes, view_weight)
        weight += view_weight
        share = torch.maximum(share, feather)
    classes.lerp_(mean / weight.clamp_min(1e-6), share)
    person, hair = classes[1:].clone(), class_index("hair") - 1
    person[hair] *= _HAIR
    kept = classes[1:].sum(0) / person.sum(0).clamp_min(1e-6)
    classes = torch.cat([classes[:1], person * kept])
    classes = with_ears(classes, views[2], _centres_px(size, image_srgb.shape))
    return classes / classes.sum(0).clamp_min(1e-6)


def _within_share(classes: Tensor, person: np.ndarray) -> Tensor:
    """Scale classes [C, h, w] to the coverage [h, w] of a person.

    Where the Parsing Network predicts no person, a pixel has the classes of the nearest pixel where it does.
    """
    share = torch.from_numpy(person).float()
    nearest = distance_transform_edt(1 - classes[0] < _CLASSLESS, return_distances=False, return_indices=True)
    rows, columns = torch.from_numpy(nearest).long()
    of_person = classes[1:, rows, columns]
    of_person = of_person / of_person.sum(0).clamp_min(1e-6)
    return torch.cat([1 - share[None], of_person * share])


def small_image(image_srgb: np.ndarray) -> Tensor:
    """Resize an sRGB uint8 image to the size of its classes [3, h, w], in 0..1."""
    size = fitted(image_srgb.shape[0], image_srgb.shape[1], _SMALL_PX)
    small = shrunk(image_srgb, size) / np.float32(255)
    return torch.from_numpy(small).permute(2, 0, 1)


def _within(square: Square, height: int, width: int) -> Square:
    """Move and, if necessary, shrink the square so that little of it lies outside the photo."""
    side_px = min(square.side_px, float(max(height, width)))
    x_px, y_px = (
        min(max(at, side_px / 2), length - side_px / 2) if length > side_px else length / 2
        for at, length in ((square.x_px, width), (square.y_px, height))
    )
    return Square(x_px, y_px, side_px)


def _centres_px(size: tuple[int, int], shape: tuple[int, ...]) -> np.ndarray:
    """Return the pixel centres [h, w, 2] of a small image, in the photo's pixels."""
    y = (np.arange(size[0]) + PIXEL_CENTRE) * shape[0] / size[0]
    x = (np.arange(size[1]) + PIXEL_CENTRE) * shape[1] / size[1]
    return np.stack(np.meshgrid(x, y), -1)


def with_ears(classes: Tensor, view: SquareView, places_px: np.ndarray) -> Tensor:
    """Raise the odds of ears in classes [C, h, w] at pixels whose positions in the photo are [h, w, 2].

    Ears are small and get the benefit of the doubt near the line through the landmarks of top, back and lobe.
    Odds are multiplied, so certain predictions (hair over the ears, a hat) stay. Only ears, background, skin,
    hair and neck change.
    """
    lifted, ears = classes.clone(), class_index("ears")
    other = classes[_EAR_OTHERS].sum(0)
    both = classes[ears] + other
    likelier = classes[ears] * torch.from_numpy(np.exp(_EAR_LIFT * _nearness(view, places_px))).float()
    lifted[ears] = both * likelier / (likelier + other).clamp_min(1e-9)
    lifted[_EAR_OTHERS] *= (both - lifted[ears]) / other.clamp_min(1e-9)
    return lifted


def _nearness(view: SquareView, places_px: np.ndarray) -> np.ndarray:
    """Return the proximity [h, w] in 0..1 of positions [h, w, 2] to the lines of both ears."""
    near = np.zeros(places_px.shape[:2])
    width_px = _EAR_WIDTH * max(view.extent_px, 1.0)
    for line in (view.landmarks_px[ear] for ear in _EAR_LINES):
        low, high = line.min(0) - _EAR_REACH * width_px, line.max(0) + _EAR_REACH * width_px
        around = ((places_px > low) & (places_px < high)).all(-1)
        distances_px = []
        for start, end in pairwise(line):
            along, offset = end - start, places_px[around] - start
            fraction = ((offset @ along) / max(float(along @ along), 1e-9)).clip(0, 1)
            distances_px.append(np.linalg.norm(offset - fraction[..., None] * along, axis=-1))
        nearest_px = np.min(distances_px, 0)
        near[around] = np.maximum(near[around], np.exp(-0.5 * (nearest_px / width_px) ** 2))
    return near


def with_cloth(classes: Tensor, image: Tensor, head: HeadPlace) -> Tensor:
    """Turn regions of skin that cannot be skin into garment, in classes [C, h, w].

    The Parsing Network classifies collars and elbows of dark suits as skin or hand, which would be lit as
    such. The photo's colours distinguish them from the person's skin. A region ends at edges of the photo. It
    is cloth if most of its chromaticities lie outside those of the whole face, lit and shaded, it is large
    enough, and little of its outline borders certain skin.

    Args:
        classes: Probabilities of the classes, which sum to 1.
        image: sRGB [3, h, w] in 0..1.
        head: The person's head, in pixels of the image.
    """
    shares = classes.numpy()
    red, green, blue = srgb_to_linear(image.numpy())
    face = (shares[_SKIN_CLASSES[0]] > _CERTAIN) & (head.distance(green.shape) < _FACE_REACH)
    if not face.any():
        return classes
    outside = np.zeros_like(face)
    for channel in (red, blue):
        ratio = (channel[face] + _BLACK) / (green[face] + _BLACK)
        darkest, brightest = (
            (green * bound + _NOISE) / (green + _NOISE) for bound in np.quantile(ratio, (0.02, 0.98))
        )
        ratio = (channel + _NOISE) / (green + _NOISE)
        outside |= (ratio < darkest / _MARGIN) | (ratio > brightest * _MARGIN)
    person = 1 - shares[0]
    skin = shares[_SKIN_CLASSES].sum(0) > _MAYBE * np.maximum(person, _MAYBE)
    edges = gaussian_gradient_magnitude(np.log(image.numpy().mean(0) + _DARK), 1.0) > _CLOTH_EDGE
    certain = (shares[_FACE_CLASSES].sum(0) > _SURE_BESIDE) | (shares[_HAND] > _SURE_BESIDE)
    parts, _ = label(skin & ~edges)
    sizes = np.bincount(parts.ravel())
    sizes[0] = 0
    cloth = np.zeros_like(skin)
    for number in np.flatnonzero(sizes > _LEAST_PART * person.sum()):
        part = parts == number
        if outside[part].mean() > 0.5:
            part |= binary_dilation(part, iterations=_EDGE_PX, mask=skin & outside)
            outline = binary_dilation(part) & ~part
            if certain[outline].mean() < _TOUCHES:
                cloth |= part
    changed = classes.clone()
    moved = classes[_SKIN_CLASSES] * torch.from_numpy(cloth)
    changed[_SKIN_CLASSES] -= moved
    changed[_GARMENT] += moved.sum(0)
    return changed
