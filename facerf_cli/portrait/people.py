"""Mattes of the people in a photo, by networks that have seen real people and by the photo's colours.

MediaPipe's person network looks at the whole photo and at squares around each head; where there are several
people, its body network tells whose a pixel is; near the outline closed-form matting decides.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
import torch.nn.functional as F
from scipy.ndimage import (
    binary_propagation,
    distance_transform_edt,
    gaussian_filter,
    gaussian_gradient_magnitude,
    label,
    watershed_ift,
)

from facerf_cli.face.head import OtherHead
from facerf_cli.image.colour import srgb_to_linear
from facerf_cli.image.strips import enlarged, fitted
from facerf_cli.network.stored_graph import PeopleNetworks, StoredGraph
from facerf_cli.portrait.matte import lifted, shrunk, solve_matte, solved_before_plain_background
from facerf_cli.portrait.parse import Square

_SOLVED_PX, _SOLVED_HEAD_PX = 768, 320  # longest side, and height of the head, at which the outline is solved
_NETWORK_PX = 256
# Squares around a head, in its heights; how far their middle is below the face's; how much of a square must
# lie in the photo; weight of the smallest over that of the whole photo, times its side.
_SIDES, _BELOW, _FILLED, _WEIGHT = (2.2, 3.5, 6.0), 0.06, 0.3, 8.0
_RIM = 0.12  # of a square, in its sides, over which its weight rises
_VETO = 0.8  # of the Parsing Network, where it sees less of a person below the eyes
_HAIR_BAND, _BODY_BAND = 0.05, 0.014  # half widths of the outline that is solved, in heights of the head
_MAYBE, _DIM = 0.15, 0.3  # least share of a flat part, and its least brightness
_FLAT = 0.015  # its largest change over a pixel, as a share of the brightness
_HOLE = 0.12  # side of holes that are filled, in heights of the head
_BODY_SIDES, _BODY_BELOW = 5.5, 1.6  # square of the first look at a body, in heights of the head
_CLAIM, _LEAD = 0.6, 0.5  # a body claims a pixel from here on, where the next one's is below this part of it


@dataclass(frozen=True)
class HeadPlace:
    """A head in pixels: the middle between brows and chin, height from hairline to chin, and the chin's y."""

    x_px: float
    y_px: float
    height_px: float
    chin_px: float

    @classmethod
    def of(cls, landmarks_px: np.ndarray) -> "HeadPlace":
        """The head of 68 landmarks [68, 2]."""
        brows, chin = landmarks_px[17:27].mean(0), landmarks_px[8]
        x_px, y_px = (brows + chin) / 2
        width_px = float(np.ptp(landmarks_px[:17, 0]))
        height_px = 1.4 * max(float(np.linalg.norm(brows - chin)), 0.6 * width_px)
        return cls(float(x_px), float(y_px), height_px, float(chin[1]))

    def scaled(self, scale: float) -> "HeadPlace":
        """The head in a photo resized by a factor."""
        return HeadPlace(*(scale * value for value in (self.x_px, self.y_px, self.height_px, self.chin_px)))

    def distance(self, shape: tuple[int, ...], above: float = 0.0) -> np.ndarray:
        """Distance [h, w] of pixels from the middle, or from a point above it, in heights."""
        y, x = np.ogrid[: shape[0], : shape[1]]
        return np.hypot(x - self.x_px, y - self.y_px + above * self.height_px) / self.height_px


@dataclass(frozen=True, eq=False)
class PersonShares:
    """Shares [h, w] of a person: as all networks say together, and of anybody as the person network says."""

    person: np.ndarray
    anybody: np.ndarray


def person_among(
    people: PeopleNetworks,
    image: np.ndarray,
    head: HeadPlace,
    others: Sequence[OtherHead],
    parsed: np.ndarray,
) -> PersonShares:
    """Find the person with a head among others in a small image.

    Args:
        people: The networks that find and cut out people.
        image: sRGB [h, w, 3] in 0..1.
        head: The person's head.
        others: The other heads.
        parsed: Share [h, w] that the Parsing Network sees; it alone knows faces that fill the photo.
    """
    if not _squares_around(head, image.shape):
        return PersonShares(parsed, parsed)
    anybody, body = person_share(people.person, image, head), body_share(people.body, image, head)
    share = np.maximum(anybody, body * (1 - _below_eyes(body, head)) * _near(body, head))  # hats
    if others:
        persons, bodies = zip(*(_shares_of(one, people, image) for one in others), strict=True)
        heads = [head, *(HeadPlace.of(one.landmarks_px) for one in others)]
        anybody = np.maximum.reduce([anybody, *persons])
        share = share * part_of_first([body, *bodies], heads, np.maximum(share, anybody), image)
    return PersonShares(_vetoed(share, parsed, head), anybody)


def _shares_of(other: OtherHead, people: PeopleNetworks, image: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Shares [h, w] of anybody and of the body of another head of an image; looked at once."""
    if not other.seen or not np.array_equal(other.seen[0], image):
        head = HeadPlace.of(other.landmarks_px)
        person, body = person_share(people.person, image, head), body_share(people.body, image, head)
        other.seen[:] = image, person, body
    return other.seen[1], other.seen[2]


def matte_of(share: np.ndarray, image_srgb: np.ndarray, landmarks_px: np.ndarray) -> np.ndarray:
    """The matte [H, W] of a person with a share [h, w] and landmarks [68, 2] in an image [H, W, 3] uint8."""
    height, width = image_srgb.shape[:2]
    head = HeadPlace.of(landmarks_px)
    longest_px = max(height, width)
    most_px = min(_SOLVED_PX, _SOLVED_HEAD_PX / head.height_px * longest_px)
    size = fitted(height, width, most_px)
    image = shrunk(image_srgb, size) / np.float32(255)
    scaled = head.scaled(max(size) / longest_px)
    whole = with_flat_parts(np.asarray(enlarged(share[None], size)[0]).clip(0, 1), image, scaled)
    expected, unknown = outline(whole, scaled)
    alpha = solve_matte(image, expected, unknown)
    alpha = solved_before_plain_background(alpha, srgb_to_linear(image))
    return alpha if size == (height, width) else lifted(alpha, image, image_srgb)


def person_share(network: StoredGraph, image: np.ndarray, head: HeadPlace) -> np.ndarray:
    """Share [h, w] that is a person in an image [h, w, 3] in 0..1, looked at around a head.

    Squares that reach beyond the photo show a close-up from further away, as the network knows people.
    """
    height, width = image.shape[:2]
    squares = _squares_around(head, image.shape)
    photo = torch.from_numpy(image).permute(2, 0, 1)
    whole = F.interpolate(photo[None], (_NETWORK_PX, _NETWORK_PX), mode="area")[0]
    views = torch.stack([whole, *(square.cut(image, _NETWORK_PX) for square in squares)])
    seen = network(torch.cat([views, views.flip(3)]))["share"]
    seen = (seen[: len(views)] + seen[len(views) :].flip(3)) / 2
    total = F.interpolate(seen[:1], (height, width), mode="bilinear", align_corners=False)[0, 0]
    weights = torch.ones(height, width)
    for square, one in zip(squares, seen[1:], strict=True):
        placed, weight = square.laid_over(one, (height, width), (height, width), _RIM)
        weight = weight * (_WEIGHT * head.height_px / square.side_px)
        total, weights = total + placed[0] * weight, weights + weight
    return np.asarray((total / weights).numpy())


def body_share(network: StoredGraph, image: np.ndarray, head: HeadPlace) -> np.ndarray:
    """Share [h, w] that is the body of a head, in an image [h, w, 3] in 0..1; 0 where no body is seen.

    The first square follows from the head, the second from the hips and the circle around the body that the
    network finds there.
    """
    shape = image.shape[0], image.shape[1]
    side_px = _BODY_SIDES * head.height_px
    square = Square(head.x_px, head.y_px + _BODY_BELOW * head.height_px, side_px)
    total, weights, best = torch.zeros(shape), torch.zeros(shape), 0.0
    for _ in range(2):
        out = network(square.cut(image, _NETWORK_PX)[None])
        score = float(out["score"])
        places = out["points"].reshape(39, 5)[:, :2].numpy() / _NETWORK_PX
        nose, hips, rim = square.to_photo(places[[0, 33, 34]])
        if math.hypot(nose[0] - head.x_px, nose[1] - head.y_px) > 0.8 * head.height_px or score < 0.3:
            break  # nobody, or somebody else
        best = max(best, score)
        placed, weight = square.laid_over(out["mask"][0].sigmoid(), shape, shape, _RIM)
        total, weights = total + placed[0] * weight, weights + weight
        radius = min(max(1.25 * math.hypot(*(rim - hips)), side_px / 2), 5 * head.height_px)
        square = Square(float(hips[0]), float(hips[1]), 2 * radius)
    return np.asarray((best * total / weights.clamp_min(1)).numpy())


def part_of_first(
    bodies: Sequence[np.ndarray], heads: Sequence[HeadPlace], person: np.ndarray, image: np.ndarray
) -> np.ndarray:
    """Part [h, w] of each pixel that belongs to the first of several people.

    Faces, and what one body alone claims, are seeds; other pixels of people go to the seed that reaches them
    along the least contrast.
    """
    most, next_most, owner = np.zeros_like(bodies[0]), np.zeros_like(bodies[0]), np.zeros(person.shape, int)
    for number, body in enumerate(bodies, 1):
        owner[body > most] = number
        next_most = np.maximum(next_most, np.minimum(most, body))
        most = np.maximum(most, body)
    seeds = np.where((most > _CLAIM) & (next_most < _LEAD * most), owner, 0)
    for number, head in enumerate(heads, 1):
        seeds[head.distance(person.shape) < 0.35] = number
    anybody = (person > 0.5) | (seeds > 0)
    contrast = gaussian_gradient_magnitude(image.mean(2), 1.0)
    scale = max(float(np.percentile(contrast[anybody], 98)), 1e-6)
    cost = (contrast / scale * 200).clip(0, 200).astype(np.uint8)
    cost[~anybody] = 255
    owner = watershed_ift(cost, seeds.astype(np.int16))
    soft = max(1.0, 0.01 * float(np.mean([head.height_px for head in heads])))
    return np.asarray(gaussian_filter((owner == 1).astype(np.float32), soft))


def with_flat_parts(share: np.ndarray, image: np.ndarray, head: HeadPlace) -> np.ndarray:
    """A share [h, w] that is 1 where a part of the person above the eyes goes on in an image [h, w, 3].

    Networks take a tall hat's crown for the background, but no outline crosses a plain surface; in the dark
    none is seen. What the outline's band reaches is solved there.
    """
    person, light = share > 0.5, image.mean(2)
    above = (np.arange(len(share))[:, None] < head.y_px) & (head.distance(share.shape) < 2)
    flat = (light > _DIM) & (gaussian_gradient_magnitude(light, 1.0) < _FLAT * light)
    more = binary_propagation(person, mask=person | (flat & above & (share > _MAYBE))) & ~person
    deep = more & (distance_transform_edt(~person) > _HAIR_BAND * head.height_px)
    return np.where(binary_propagation(deep, mask=more), np.float32(1), share)


def outline(share: np.ndarray, head: HeadPlace) -> tuple[np.ndarray, np.ndarray]:
    """Expected alpha [h, w] of a share [h, w], 0 or 1 but near the outline, and where it is unknown."""
    person = _one_piece(share > 0.5, head)
    y = np.arange(len(share))[:, None]
    hair = (y < head.chin_px) & (head.distance(share.shape) < 2)
    band_px = np.maximum(np.where(hair, _HAIR_BAND, _BODY_BAND) * head.height_px, 1.5)
    inside, outside = distance_transform_edt(person), distance_transform_edt(~person)
    unknown = np.where(person, inside, outside) <= band_px
    return np.where(unknown, share, person), unknown


def _vetoed(share: np.ndarray, seen: np.ndarray, head: HeadPlace) -> np.ndarray:
    """A share without what the Parsing Network, which knows no hats, takes away from the eyes down."""
    taken = _VETO * _near(share, head) * _below_eyes(share, head)
    return np.asarray(share - taken * (share - seen).clip(0))


def _near(share: np.ndarray, head: HeadPlace) -> np.ndarray:
    """1 up to a height of the head from its middle, falling to 0 at two [h, w]."""
    return np.asarray((2.0 - head.distance(share.shape, above=0.15)).clip(0, 1))


def _below_eyes(share: np.ndarray, head: HeadPlace) -> np.ndarray:
    """0 above the eyes, 1 below them [h, 1]."""
    y = np.arange(len(share))[:, None]
    return np.asarray(((y - head.y_px + 0.1 * head.height_px) / (0.15 * head.height_px)).clip(0, 1))


def _one_piece(person: np.ndarray, head: HeadPlace) -> np.ndarray:
    """The connected part of people [h, w] that holds a face, with small holes filled."""
    parts, count = label(person)
    in_face = np.bincount(parts[head.distance(person.shape) < 0.35], minlength=count + 1)
    in_face[0] = 0
    if not in_face.any():
        return person
    mine = parts == in_face.argmax()
    holes, _ = label(~mine)
    small = np.bincount(holes.ravel()) < (_HOLE * head.height_px) ** 2
    small[0] = False
    return np.asarray(mine | small[holes])


def _squares_around(head: HeadPlace, shape: tuple[int, ...]) -> list[Square]:
    """The squares around a head that show enough of a photo."""
    squares = [
        Square(head.x_px, head.y_px + _BELOW * side * head.height_px, side * head.height_px)
        for side in _SIDES
    ]
    return [square for square in squares if _filled(square, shape) >= _FILLED]


def _filled(square: Square, shape: tuple[int, ...]) -> float:
    """Share of a square that lies in a photo."""
    half = square.side_px / 2
    sides = (
        max(0.0, min(middle + half, length) - max(middle - half, 0.0))
        for middle, length in ((square.x_px, shape[1]), (square.y_px, shape[0]))
    )
    return math.prod(sides) / square.side_px**2
