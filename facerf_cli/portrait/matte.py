"""Mattes of the people in a photo, from networks trained on real people and from the photo's colours.

MediaPipe's person network processes the whole photo and squares around each head. If there are several
people, its body network assigns each pixel to a person. Near the outline, closed-form matting solves for
alpha, which is then enlarged to the photo's resolution. `PersonColours` removes the background's colours.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from itertools import product

import numpy as np
import torch
import torch.nn.functional as F
from scipy.ndimage import (
    binary_dilation,
    binary_propagation,
    distance_transform_edt,
    gaussian_filter,
    gaussian_gradient_magnitude,
    label,
    maximum_filter,
    uniform_filter,
    watershed_ift,
)
from scipy.sparse import csr_array, dia_array

from facerf_cli.face.head import OtherHead
from facerf_cli.image.colour import srgb_to_linear
from facerf_cli.image.strips import between, box_means, enlarged, fitted, strips
from facerf_cli.network.stored_graph import PeopleNetworks, StoredGraph
from facerf_cli.portrait.parse import Square

_SOLVED_PX, _SOLVED_HEAD_PX = 768, 320  # longest side, and height of the head, at which alpha is solved
_NETWORK_PX = 256
# Squares around a head, in its heights; distance of their middle below the face's; least fraction of a square
# inside the photo; weight of a square relative to that of the whole photo, times its side.
_SIDES, _BELOW, _FILLED, _WEIGHT = (2.2, 3.5, 6.0), 0.06, 0.3, 8.0
_RIM = 0.12  # border of a square, in its sides, over which its weight rises
_VETO = 0.8  # weight of the Parsing Network where it predicts less of a person below the eyes
_HAIR_BAND, _BODY_BAND = 0.05, 0.014  # half widths of the solved outline, in heights of the head
_MAYBE, _DIM = 0.15, 0.3  # least coverage and brightness of a flat region
_FLAT = 0.015  # its largest relative change of brightness per pixel
_HOLE = 0.12  # side of holes that are filled, in heights of the head
_BODY_SIDES, _BODY_BELOW = 5.5, 1.6  # first square for the body network, in heights of the head
_CLAIM, _LEAD = 0.6, 0.5  # least coverage of a seed, and largest fraction of it that another body may have
_REACH_PX = 2  # of the linear functions of colour for enlarging a matte
_TILE_PX = 64  # side of the parts of a matte that are processed at once: they stay in the processor's cache
_SMOOTHNESS = 1e-5  # variance of colours, sRGB in 0..1, below which the matte is smoothed
_COLOURS_PX = 512  # longest side at which colours are estimated
_COLOUR_REACH = (0.03, 0.006)  # of the successive means of colours, in longest sides
_SURE = (0.05, 0.93)  # alpha that becomes 0 and 1
_OUTLINE_PX = 768  # longest side at which distances from the outline are measured
_SOLID_PX = (1.0, 3.0)  # range of distances from the outline over which alpha becomes 1 inside, 0 outside
_LOOSE_PX = 7  # side of the square around loose hair in which the matte is unchanged
_LEFT = 0.7  # least fraction of the nearby background in a mixture
_SAME_COLOUR = 1e-5  # variance of a window's colours, sRGB in 0..1, below which its alpha is constant
_PULL = 3e-3  # toward the expected alpha
_TOLERANCE, _MOST_STEPS = 1e-3, 200
_WINDOW = 9  # pixels
_SMALL_PX = 256  # longest side for measuring colours in front of a plain background
_NEAR, _FAR = 0.1, 0.2  # sides of the squares of their means, in longest sides
_ALLOWED = 0.1  # deviation of alpha, from the colours' variance, that halves the trust
_PLAIN_SURE = (0.02, 0.95)  # alpha up to which a pixel is background, and from which it is person
_SEEN = 0.02  # least fraction of certain pixels in a square
_TINY = 1e-5


@dataclass(frozen=True)
class HeadPlace:
    """Head in pixels: the middle between brows and chin, height from hairline to chin, and the chin's y."""

    x_px: float
    y_px: float
    height_px: float
    chin_px: float

    @classmethod
    def of(cls, landmarks_px: np.ndarray) -> "HeadPlace":
        brows, chin = landmarks_px[17:27].mean(0), landmarks_px[8]
        x_px, y_px = (brows + chin) / 2
        width_px = float(np.ptp(landmarks_px[:17, 0]))
        height_px = 1.4 * max(float(np.linalg.norm(brows - chin)), 0.6 * width_px)
        return cls(float(x_px), float(y_px), height_px, float(chin[1]))

    def scaled(self, scale: float) -> "HeadPlace":
        return HeadPlace(*(scale * value for value in (self.x_px, self.y_px, self.height_px, self.chin_px)))

    def distance(self, shape: tuple[int, ...], above: float = 0.0) -> np.ndarray:
        """Return the distance [h, w] of pixels from the middle, or from a point above it, in heights."""
        y, x = np.ogrid[: shape[0], : shape[1]]
        return np.hypot(x - self.x_px, y - self.y_px + above * self.height_px) / self.height_px


def person_among(
    people: PeopleNetworks,
    image: np.ndarray,
    head: HeadPlace,
    others: Sequence[OtherHead],
    parsed: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """Find the person with a head among others in a small image.

    Return the person's coverage [h, w] from all networks, and that of all people from the person network.

    Args:
        people: The networks that find and cut out people.
        image: sRGB [h, w, 3] in 0..1.
        head: The person's head.
        others: The other heads.
        parsed: The Parsing Network's coverage [h, w]; only this network handles faces that fill the photo.
    """
    if not _squares_around(head, image.shape):
        return parsed, parsed
    anybody, body = person_coverage(people.person, image, head), body_coverage(people.body, image, head)
    share = np.maximum(anybody, body * (1 - _below_eyes(body, head)) * _near(body, head))  # hats
    if others:
        persons, bodies = zip(*(_coverage_of(other, people, image) for other in others), strict=True)
        heads = [head, *(HeadPlace.of(other.landmarks_px) for other in others)]
        anybody = np.maximum.reduce([anybody, *persons])
        share = share * part_of_first([body, *bodies], heads, np.maximum(share, anybody), image)
    # The Parsing Network is not trained on hats: it lowers the coverage only below the eyes.
    lowered = _VETO * _near(share, head) * _below_eyes(share, head) * (share - parsed).clip(0)
    return np.asarray(share - lowered), anybody


def _coverage_of(
    other: OtherHead, people: PeopleNetworks, image: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the coverage [h, w] of people and of another head's body; computed once per image."""
    if not other.seen or not np.array_equal(other.seen[0], image):
        head = HeadPlace.of(other.landmarks_px)
        person, body = person_coverage(people.person, image, head), body_coverage(people.body, image, head)
        other.seen[:] = image, person, body
    return other.seen[1], other.seen[2]


def matte_of(share: np.ndarray, image_srgb: np.ndarray, landmarks_px: np.ndarray) -> np.ndarray:
    """Solve the matte [H, W] of a person with coverage [h, w] and landmarks [68, 2] in an image [H, W, 3]."""
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
    return alpha if size == (height, width) else enlarge_matte(alpha, image, image_srgb)


def person_coverage(network: StoredGraph, image: np.ndarray, head: HeadPlace) -> np.ndarray:
    """Return the coverage [h, w] of people in an image [h, w, 3] in 0..1, from views around a head.

    Squares that reach beyond the photo show a close-up from further away, as in the network's training.
    """
    height, width = image.shape[:2]
    squares = _squares_around(head, image.shape)
    photo = torch.from_numpy(image).permute(2, 0, 1)
    whole = F.interpolate(photo[None], (_NETWORK_PX, _NETWORK_PX), mode="area")[0]
    views = torch.stack([whole, *(square.cut(image, _NETWORK_PX) for square in squares)])
    shares = network(torch.cat([views, views.flip(3)]))["share"]
    shares = (shares[: len(views)] + shares[len(views) :].flip(3)) / 2
    total = F.interpolate(shares[:1], (height, width), mode="bilinear", align_corners=False)[0, 0]
    weights = torch.ones(height, width)
    for square, share in zip(squares, shares[1:], strict=True):
        placed, weight = square.laid_over(share, (height, width), (height, width), _RIM)
        weight = weight * (_WEIGHT * head.height_px / square.side_px)
        total, weights = total + placed[0] * weight, weights + weight
    return np.asarray((total / weights).numpy())


def body_coverage(network: StoredGraph, image: np.ndarray, head: HeadPlace) -> np.ndarray:
    """Return the coverage [h, w] of a head's body in an image [h, w, 3] in 0..1; 0 if no body is found.

    The first square follows from the head, the second from the hips and the circle around the body that the
    network detects in it.
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
            break  # no body, or another person's
        best = max(best, score)
        placed, weight = square.laid_over(out["mask"][0].sigmoid(), shape, shape, _RIM)
        total, weights = total + placed[0] * weight, weights + weight
        radius = min(max(1.25 * math.hypot(*(rim - hips)), side_px / 2), 5 * head.height_px)
        square = Square(float(hips[0]), float(hips[1]), 2 * radius)
    return np.asarray((best * total / weights.clamp_min(1)).numpy())


def part_of_first(
    bodies: Sequence[np.ndarray], heads: Sequence[HeadPlace], person: np.ndarray, image: np.ndarray
) -> np.ndarray:
    """Return the fraction [h, w] of each pixel that belongs to the first of several people.

    Seeds are faces, and pixels that only one body claims. Other pixels of people go to the seed that reaches
    them along the least contrast.
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
    """Extend coverage [h, w] to 1 over flat regions above the eyes that continue the person.

    Networks classify the crown of a tall hat as background, but no outline crosses a plain surface of an
    image [h, w, 3]. In the dark no outline is visible, so nothing changes there. Regions within the outline's
    band are left to matting.
    """
    person, light = share > 0.5, image.mean(2)
    above = (np.arange(len(share))[:, None] < head.y_px) & (head.distance(share.shape) < 2)
    flat = (light > _DIM) & (gaussian_gradient_magnitude(light, 1.0) < _FLAT * light)
    more = binary_propagation(person, mask=person | (flat & above & (share > _MAYBE))) & ~person
    deep = more & (distance_transform_edt(~person) > _HAIR_BAND * head.height_px)
    return np.where(binary_propagation(deep, mask=more), np.float32(1), share)


def outline(share: np.ndarray, head: HeadPlace) -> tuple[np.ndarray, np.ndarray]:
    """Return expected alpha [h, w], which is 0 or 1 except near the outline, and where it is unknown."""
    person = _one_piece(share > 0.5, head)
    y = np.arange(len(share))[:, None]
    hair = (y < head.chin_px) & (head.distance(share.shape) < 2)
    band_px = np.maximum(np.where(hair, _HAIR_BAND, _BODY_BAND) * head.height_px, 1.5)
    inside, outside = distance_transform_edt(person), distance_transform_edt(~person)
    unknown = np.where(person, inside, outside) <= band_px
    return np.where(unknown, share, person), unknown


def _near(share: np.ndarray, head: HeadPlace) -> np.ndarray:
    """Return 1 up to one height of the head from its middle, falling to 0 at two heights [h, w]."""
    return np.asarray((2.0 - head.distance(share.shape, above=0.15)).clip(0, 1))


def _below_eyes(share: np.ndarray, head: HeadPlace) -> np.ndarray:
    """Return 0 above the eyes and 1 below them [h, 1]."""
    y = np.arange(len(share))[:, None]
    return np.asarray(((y - head.y_px + 0.1 * head.height_px) / (0.15 * head.height_px)).clip(0, 1))


def _one_piece(person: np.ndarray, head: HeadPlace) -> np.ndarray:
    """Return the connected region [h, w] that contains the face, with small holes filled."""
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
    """Return the squares around a head that lie sufficiently inside a photo."""
    squares = []
    for side in _SIDES:
        square = Square(head.x_px, head.y_px + _BELOW * side * head.height_px, side * head.height_px)
        half = square.side_px / 2
        sides_inside = (
            max(0.0, min(middle + half, length) - max(middle - half, 0.0))
            for middle, length in ((square.x_px, shape[1]), (square.y_px, shape[0]))
        )
        if math.prod(sides_inside) / square.side_px**2 >= _FILLED:
            squares.append(square)
    return squares


def enlarge_matte(alpha: np.ndarray, image: np.ndarray, photo_srgb: np.ndarray) -> np.ndarray:
    """Enlarge a matte [h, w] to a photo [H, W, 3] uint8; `image` [h, w, 3] in 0..1 is the small photo.

    Fast guided filter (He et al., *Guided image filtering*, 2013; He and Sun, 2015): linear functions of the
    colour around each pixel are fitted at the small size and applied at the large one.
    """
    margin = 2 * _REACH_PX
    maps = np.concatenate([np.zeros((3, *alpha.shape), np.float32), alpha[None]])  # where alpha is constant
    for row, column in product(*(range(0, length, _TILE_PX) for length in alpha.shape)):
        top, left = max(0, row - margin), max(0, column - margin)
        around = np.s_[top : row + _TILE_PX + margin, left : column + _TILE_PX + margin]
        if alpha[around].min() < alpha[around].max():
            fitted_maps = _linear_functions(alpha[around], image[around])
            tile = maps[:, row : row + _TILE_PX, column : column + _TILE_PX]
            tile[:] = fitted_maps[:, row - top :, column - left :][:, : tile.shape[1], : tile.shape[2]]
    size = photo_srgb.shape[:2]
    matte = np.empty(size, np.float32)
    for rows in strips(size):
        lines = enlarged(maps, size, rows)
        colours = photo_srgb[rows].transpose(2, 0, 1) / np.float32(255)
        matte[rows] = ((lines[:3] * colours).sum(0) + lines[3]).clip(0, 1)
    return matte


def _linear_functions(alpha: np.ndarray, image: np.ndarray) -> np.ndarray:
    """Return slopes and offset [4, h, w] of the linear functions of colour; see `enlarge_matte`."""
    mean = partial(box_means, reach=_REACH_PX)
    colour, value = mean(image), mean(alpha[..., None])
    covariance, common = (
        mean(image[..., :, None] * other[..., None, :]) - colour[..., :, None] * of_other[..., None, :]
        for other, of_other in ((image, colour), (alpha[..., None], value))
    )
    slope = np.linalg.solve(covariance + _SMOOTHNESS * np.eye(3, dtype=np.float32), common)  # [h, w, 3, 1]
    offset = value - (slope * colour[..., None]).sum(-2)
    return np.concatenate([mean(slope)[..., 0], mean(offset)], -1).transpose(2, 0, 1)


def solid(matte: np.ndarray, loose: np.ndarray) -> np.ndarray:
    """Make a matte [H, W] 1 inside its outline and 0 outside, except in loose hair of coverage [h, w].

    Skin and cloth are opaque and end at their outline. But a jaw lit by the background has a colour between
    both, and over a dark background a matte has a haze. In hair also, nearly certain alpha becomes certain: a
    hundredth of a bright wall would appear as speckles on a dark suit.
    """
    size, (first, last) = fitted(matte.shape[0], matte.shape[1], _OUTLINE_PX), _SOLID_PX
    inside = shrunk(matte, size) > 0.5
    tight = 1 - enlarged(maximum_filter(loose, _LOOSE_PX)[None], size)[0]
    deep = [
        ((distance_transform_edt(part) - first) / (last - first)).clip(0, 1) for part in (inside, ~inside)
    ]
    changed, result = np.stack(deep) * tight, np.empty_like(matte)
    for rows in strips(matte.shape):
        filled, cleared = enlarged(changed, matte.shape, rows)
        sure = ((matte[rows] - _SURE[0]) / (_SURE[1] - _SURE[0])).clip(0, 1)
        result[rows] = (sure + filled * (1 - sure)) * (1 - cleared)
    return result


class PersonColours:
    """The person's colours [H, W, 3] without the background's, where a matte [H, W] mixes them; by rows.

    They are means of certain nearby colours, corrected by the photo's mixture (Forte, *Approximate fast
    foreground colour estimation*, 2021). The means come from a photo of at most `_COLOURS_PX`. A colour is at
    most as bright as a mixture with most of the nearby background allows, so that relighting a haze takes no
    more than that from a dark background.
    """

    def __init__(self, photo: np.ndarray, matte: np.ndarray) -> None:
        self.shape = photo.shape
        self._photo, self._matte = photo, matte
        size = fitted(matte.shape[0], matte.shape[1], _COLOURS_PX)
        mixture, share = shrunk(photo, size), shrunk(matte, size)
        person = own = background = mixture
        for reach in _COLOUR_REACH:
            span = max(3, 2 * round(reach * max(size)) + 1)
            own = weighted_mean(person, share, span)
            background = weighted_mean(background, 1 - share, span)
            person = _unmixed(mixture, share, own, background)
        self._means = np.concatenate([own, background], -1)
        self.small = person * (share > 0)[..., None]  # [h, w, 3], of at most `_COLOURS_PX`

    def __getitem__(self, rows: slice, /) -> np.ndarray:
        photo, matte = self._photo[rows], self._matte[rows]
        colours = photo * (matte > 0)[..., None]
        mixed = np.nonzero((matte > 0) & (matte < 1))
        if len(mixed[0]):
            y = mixed[0] + rows.indices(self.shape[0])[0]
            own, background = np.split(_looked_up(self._means, y, mixed[1], self.shape), 2, -1)
            mixture, share = photo[mixed], matte[mixed]
            own = _unmixed(mixture, share, own, background)
            left = _LEFT * (1 - share[:, None]) * np.minimum(background, mixture)
            colours[mixed] = np.minimum(own, (mixture - left) / share[:, None])
        return colours


def _looked_up(maps: np.ndarray, y: np.ndarray, x: np.ndarray, size: tuple[int, ...]) -> np.ndarray:
    """Return values [N, C] of maps [h, w, C] enlarged to `size`, like `enlarged`, at rows y and columns x."""
    (top, bottom, down), (left, right, along) = (
        between(at, small, large) for at, small, large in zip((y, x), maps.shape, size, strict=False)
    )
    along = along[:, None]
    above = maps[top, left] + along * (maps[top, right] - maps[top, left])
    below = maps[bottom, left] + along * (maps[bottom, right] - maps[bottom, left])
    return np.asarray(above + down[:, None] * (below - above))


def shrunk(image: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """Resize an image [H, W] or [H, W, C] by averaging its pixels, float32."""
    across, down = (_averages(*pair) for pair in zip(image.shape, size, strict=False))
    flat = np.zeros((size[0], math.prod(image.shape[1:])), np.float32)
    for rows in strips(image.shape):
        part = np.ascontiguousarray(image[rows], np.float32)
        into = slice(rows.start * size[0] // len(image), -(-rows.stop * size[0] // len(image)))
        flat[into] += across[into, rows] @ part.reshape(len(part), -1)
    sides = np.moveaxis(flat.reshape(size[0], *image.shape[1:]), 1, 0)
    means = down @ np.ascontiguousarray(sides).reshape(image.shape[1], -1)
    return np.ascontiguousarray(np.moveaxis(means.reshape(size[1], size[0], *image.shape[2:]), 0, 1))


def _averages(large: int, small: int) -> csr_array:
    """Return weights [small, large] of the mean over the pixels that each smaller pixel touches."""
    starts = np.arange(small) * large // small
    ends = -(-(np.arange(1, small + 1) * large) // small)
    counts = ends - starts
    columns = np.concatenate([np.arange(*pair) for pair in zip(starts, ends, strict=True)])
    weights = np.repeat(1 / counts, counts).astype(np.float32)
    return csr_array((weights, columns, np.concatenate([[0], counts.cumsum()])), shape=(small, large))


def _unmixed(mixture: np.ndarray, matte: np.ndarray, own: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Estimate the person's colours in mixtures [h, w, 3] from likely colours of person and background."""
    share = matte[..., None]
    rest = mixture - share * own - (1 - share) * other
    return np.asarray((own + share * rest).clip(min=0))


def weighted_mean(colours: np.ndarray, weight: np.ndarray, size: int) -> np.ndarray:
    """Average colours [H, W, 3] over squares of `size` pixels, with weights [H, W]."""
    total = uniform_filter(colours * weight[..., None], (size, size, 1), mode="nearest")
    return np.asarray(total / (uniform_filter(weight, size, mode="nearest")[..., None] + _TINY))


def solve_matte(image_srgb: np.ndarray, expected: np.ndarray, unknown: np.ndarray) -> np.ndarray:
    """Solve alpha [H, W] in 0..1 where it is unknown [H, W]; elsewhere it is as expected [H, W].

    Closed-form matting (Levin et al., *A closed-form solution to natural image matting*, 2008). Around each
    pixel, alpha is a linear function of the colour of the image [H, W, 3] in 0..1. Only windows of 3 x 3
    pixels that touch unknown ones are used, so the cost is proportional to their number.
    """
    alpha = np.array(expected, np.float64)
    if not unknown.any() or min(unknown.shape) < 3:
        return alpha.astype(np.float32)
    pixels = _windows(unknown)
    affinity = _affinities(image_srgb.reshape(-1, 3)[pixels])
    count = int(unknown.sum())
    number = np.full(unknown.size, -1)
    number[unknown.ravel()] = np.arange(count)
    rows, columns = (
        np.broadcast_to(number[pixels][sides], affinity.shape)
        for sides in (np.s_[:, :, None], np.s_[:, None])
    )
    inner, border = (rows >= 0) & (columns >= 0), (rows >= 0) & (columns < 0)
    laplacian = csr_array((affinity[inner], (rows[inner], columns[inner])), (count, count))
    known = np.broadcast_to(alpha.ravel()[pixels][:, None], affinity.shape)
    right = -np.bincount(rows[border], affinity[border] * known[border], count)
    start = alpha[unknown]
    system = laplacian + dia_array((np.full((1, count), _PULL), [0]), (count, count))
    alpha[unknown] = _conjugate_gradients(system, right + _PULL * start, start).clip(0, 1)
    return alpha.astype(np.float32)


def _conjugate_gradients(system: csr_array, right: np.ndarray, start: np.ndarray) -> np.ndarray:
    """Solve a symmetric positive definite system [N, N], preconditioned by its diagonal.

    scipy.sparse.linalg takes long to import.
    """
    solution, rest = start.copy(), right - system @ start
    inverse, along, before = 1 / system.diagonal(), np.zeros_like(right), np.inf
    for _ in range(_MOST_STEPS):
        if np.linalg.norm(rest) <= _TOLERANCE * np.linalg.norm(right):  # true if both are 0
            break
        scaled = inverse * rest
        now = rest @ scaled
        along = scaled + now / before * along
        moved = system @ along
        step = now / (along @ moved)
        solution += step * along
        rest -= step * moved
        before = now
    return solution


def _windows(unknown: np.ndarray) -> np.ndarray:
    """Return the pixel indices [N, 9] of each window that touches an unknown pixel."""
    middle = binary_dilation(unknown, np.ones((3, 3)))
    middle[[0, -1], :] = middle[:, [0, -1]] = False
    offsets = np.arange(-1, 2)[:, None] * unknown.shape[1] + np.arange(-1, 2)
    return np.flatnonzero(middle)[:, None] + offsets.ravel()


def _affinities(colours: np.ndarray) -> np.ndarray:
    """Return the matting Laplacian's entries [N, 9, 9] for windows of colours [N, 9, 3] (equation 12)."""
    centred = colours.astype(np.float64) - colours.mean(1, keepdims=True)
    covariance = centred.transpose(0, 2, 1) @ centred / _WINDOW + _SAME_COLOUR / _WINDOW * np.eye(3)
    alike = centred @ np.linalg.inv(covariance) @ centred.transpose(0, 2, 1)
    return np.asarray(np.eye(_WINDOW) - (1 + alike) / _WINDOW)


def solved_before_plain_background(alpha: np.ndarray, linear: np.ndarray) -> np.ndarray:
    """Refine an uncertain matte [H, W] of a scene-linear image [H, W, 3] over a plain background.

    Where the nearby colours of person F and background B are known and differ by more than they vary, a pixel
    I = a F + (1 - a) B has one solution, a = (B - I) . (B - F) / |B - F|^2. The background must be plain over
    a large area, because an object beside the person, such as a tree, could belong to the person.
    """
    size = fitted(alpha.shape[0], alpha.shape[1], _SMALL_PX)
    matte, image = shrunk(alpha, size), shrunk(linear, size)
    near, far = (2 * round(share * max(size) / 2) + 1 for share in (_NEAR, _FAR))
    is_person = (matte > _PLAIN_SURE[1]).astype(np.float32)
    is_background = (matte < _PLAIN_SURE[0]).astype(np.float32)
    person, person_variance, person_sure = _colours(image, is_person, near)
    background, background_variance, background_sure = _colours(image, is_background, near)
    _, variance_far, _ = _colours(image, is_background, far)
    contrast = np.square(background - person).sum(-1)
    variance = (person_variance + np.maximum(background_variance, variance_far)) / contrast.clip(min=1e-9)
    trust = np.exp2(-variance / _ALLOWED**2) * ((person_sure > _SEEN) & (background_sure > _SEEN))
    maps = np.concatenate([person, background, contrast[..., None], trust[..., None]], -1)
    own, other, apart, trust = np.split(enlarged(maps.transpose(2, 0, 1), alpha.shape), [3, 6, 7])
    along = ((other - linear.transpose(2, 0, 1)) * (other - own)).sum(0)
    solved = (along / apart[0].clip(min=1e-9)).clip(0, 1)
    unsure = (alpha > 0) & (alpha < 1)
    return np.asarray(alpha + unsure * trust[0] * (solved - alpha), np.float32)


def _colours(image: np.ndarray, sure: np.ndarray, size: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return means [h, w, 3] and variances [h, w] of certain pixels over squares, and their fraction."""
    mean = weighted_mean(image, sure, size)
    squares = weighted_mean(np.square(image), sure, size)
    fraction = weighted_mean(sure[..., None], np.ones_like(sure), size)[..., 0]
    return mean, (squares - mean**2).clip(min=0).sum(-1), fraction
