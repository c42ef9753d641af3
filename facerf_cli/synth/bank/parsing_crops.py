"""Training crops for the Parsing Network: stored photos of synthetic people, altered for every sample.

A stored photo (`people.py`) is mirrored or not, turned, scaled and shifted in the crop, over a background,
sometimes with another person in it or something in front of the face. A camera then degrades it. Wide
variation lets training on synthetic people serve for real ones (Wood et al., *Fake it till you make it*,
2021).

Synthetic people have brows and lips at the same places of one mesh, and a network could guess them from the
rest of the face. So most faces are warped: real brows lie higher or lower, real lips are thinner or thicker.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor

from facerf_cli.image.colour import linear_to_srgb
from facerf_cli.network.batch import Batch
from facerf_cli.portrait.parse import class_index
from facerf_cli.raster.camera import PIXEL_CENTRE
from facerf_cli.raster.texture import texel_centres_uv
from facerf_cli.synth.bank import split_people
from facerf_cli.synth.bank.heads import LANDMARK_GROUPS
from facerf_cli.synth.bank.people import Photo, photos_in, read_photo
from facerf_cli.synth.camera import (
    Similarity,
    SimulatedCamera,
    background,
    gaussian_blurred,
    occluder,
    recoloured,
    resample,
    rotation_2d,
    shape,
)
from facerf_cli.synth.random_fields import Uniform

_FEATURES = LANDMARK_GROUPS[1:]
_REACHES = (0.10, 0.10, 0.12, 0.08, 0.08, 0.13)  # standard deviations, in extents of the 68 landmarks
_MOVE_STD = 0.02  # in extents
_STRETCH_STD = 0.15
_MOST = 2.0  # standard deviations; beyond it a warp could fold
_ROUNDS = 8  # of the search for the place that is taken from another; each lowers its error threefold
# Shares of samples: without a person, of a body without its head, turned far, with a second person, and
# with something in front of the face; of a face whose features were moved; with decoys behind the person.
_EMPTY, _HEADLESS, _TURNED_FAR, _SECOND, _OCCLUDED = 0.06, 0.05, 0.15, 0.3, 0.25
_WARPED, _DECOYED = 0.75, 0.6
_DECOYS, _TOUCHING = 8, 0.5  # behind a person at most; share of them that touch the person's outline
_TURN_DEG, _FAR_TURN_DEG = 12.0, 50.0  # standard deviation of the turn; largest of the far ones
# Sides of the crop in extents of the landmarks: of the face, of the portrait, of a whole photo; their shares.
_SIDES, _SIDE_SHARES = ((1.25, 2.2), (2.4, 4.6), (4.6, 10.0)), (0.4, 0.4, 0.2)
_SHIFT = (0.08, 0.12, 0.24)  # largest distance of the face from the crop's centre, in sides, for these
_NEAREST_OCCLUDER = 0.1  # distance from the crop's middle, in sides
_CAMERA = SimulatedCamera(
    0.25, white=(1.35, 9.0), blur_px=2.5, curve=0.45, contrast=(-0.5, 0.25), lift=0.08, noise=0.2, jpeg=0.4
)
_BORDERED = 0.2  # fraction of crops that reach beyond the photo, where its border repeats
_BUST_BELOW = (0.8, 0.6, 0.3)  # share of crops of each side that end where the stored photo ends, or above


@dataclass(frozen=True)
class FeatureWarp:
    """Smooth warp of the plane, in pixels: the image at p shows the source at p + `shift(p)`.

    Each of K features has a centre [K, 2] and a reach [K], moves by [K, 2], and is stretched by [K, 2] along
    x and y.
    """

    centres: Tensor
    reaches: Tensor
    moves: Tensor
    stretches: Tensor

    @staticmethod
    def draw(landmarks_px: Tensor, generator: torch.Generator) -> "FeatureWarp":
        """Draw a warp of a face with landmarks [68, 2]."""
        extent = (landmarks_px.amax(0) - landmarks_px.amin(0)).max()
        moves, stretches = (
            torch.randn(2, len(_FEATURES), 2, generator=generator).clamp(-_MOST, _MOST).unbind()
        )
        return FeatureWarp(
            centres=torch.stack([landmarks_px[feature].mean(0) for feature in _FEATURES]),
            reaches=extent * torch.tensor(_REACHES),
            moves=extent * _MOVE_STD * moves,
            stretches=_STRETCH_STD * stretches,
        )

    def shift(self, places: Tensor) -> Tensor:
        """Offsets from places [..., 2] to those that are shown there."""
        total = torch.zeros_like(places)
        for centre, reach, move, stretch in zip(
            self.centres, self.reaches, self.moves, self.stretches, strict=True
        ):
            off = places - centre
            weight = torch.exp(-0.5 * off.square().sum(-1, keepdim=True) / reach**2)
            total = total + weight * (move + stretch * off)
        return total

    def shown_at(self, places: Tensor) -> Tensor:
        """Return where points [..., 2] are shown: the inverse of the warp."""
        shown = places
        for _ in range(_ROUNDS):
            shown = places - self.shift(shown)
        return shown


@dataclass(frozen=True)
class ParsingCrops(Batch):
    """Crops of B photos as a screen shows them, and what the Parsing Network should see in them."""

    crops: Tensor  # [B, 3, S, S] in 0..1
    alpha: Tensor  # [B, S, S] in 0..1
    label: Tensor  # [B, S, S] long, class of what is covered
    weight: Tensor  # [B, S, S], 0 where the truth is unknown
    landmarks: Tensor  # [B, N, 2] in sides of the crop
    known: Tensor  # [B, N] whether a landmark is in the crop
    present: Tensor  # [B] whether there is a person


class ParsingPhotos:
    """Photos of a bank, read when they are drawn."""

    def __init__(self, folder: Path, backgrounds: Tensor, provenance: dict[str, Any]) -> None:
        self.photos = photos_in(folder)
        self.backgrounds = backgrounds
        self.provenance = provenance

    def people(self, held_out: int) -> tuple[list[int], list[int]]:
        return split_people(len(self.photos), held_out)

    def draw(self, people: Sequence[int], side: int, generator: torch.Generator) -> ParsingCrops:
        """Draw one crop [1, ...] of one of some people."""
        photo = self._photo(people, generator)
        headless = torch.rand((), generator=generator) < _HEADLESS
        warp = None
        if not headless and torch.rand((), generator=generator) < _WARPED:
            warp = FeatureWarp.draw(photo.landmarks_px[:68], generator)
        draw_crop = _draw_crop_below if headless else _draw_crop
        crop = _cropped(photo, draw_crop(photo, generator), side, warp)
        if headless:
            crop = replace(crop, known=torch.zeros_like(crop.known), present=torch.zeros(1))
        if torch.rand((), generator=generator) < _EMPTY:
            crop = _without_person(crop)
        image = self._composed(crop, people, side, generator)
        if torch.rand((), generator=generator) < _OCCLUDED:
            cover = occluder(side, generator, _NEAREST_OCCLUDER)
            other = background(self.backgrounds, side, generator)
            image = image + cover * (other - image)
            crop = replace(crop, alpha=crop.alpha * (1 - cover))
        image = recoloured(image, _CAMERA.colours(generator))
        taken = _CAMERA.take(image, image.mean(), generator)
        crop = replace(crop, crops=torch.from_numpy(linear_to_srgb(taken.numpy()))[None])
        return _bordered(crop, generator) if torch.rand((), generator=generator) < _BORDERED else crop

    def _photo(self, people: Sequence[int], generator: torch.Generator) -> Photo:
        """Read a random photo of a random person of `people`, mirrored or not."""
        photos = self.photos[people[int(torch.randint(len(people), (), generator=generator))]]
        photo = read_photo(photos[int(torch.randint(len(photos), (), generator=generator))], generator)
        return photo.mirrored() if torch.rand((), generator=generator) < 0.5 else photo

    def _composed(
        self, crop: ParsingCrops, people: Sequence[int], side: int, generator: torch.Generator
    ) -> Tensor:
        """Place the crop's person over a background, and perhaps before another person: [3, side, side]."""
        image = background(self.backgrounds, side, generator)
        if torch.rand((), generator=generator) < _SECOND:
            other = self._photo(people, generator)
            behind = _cropped(other, _draw_crop_aside(other, generator), side)
            cover = behind.alpha * (behind.weight > 0)
            blur_px = float(4 * Uniform(generator)(0, 1) ** 2)
            shown, cover = (
                gaussian_blurred(x, blur_px) for x in (behind.crops[0] * (behind.weight > 0), cover)
            )
            image = shown + (1 - cover) * image
        if torch.rand((), generator=generator) < _DECOYED:
            image = _with_decoys(image, crop, generator)
        return crop.crops[0] + (1 - crop.alpha) * image


def _draw_crop(photo: Photo, generator: torch.Generator) -> Similarity:
    uniform = Uniform(generator)
    framing = int(torch.multinomial(torch.tensor(_SIDE_SHARES), 1, generator=generator))
    low, high = _SIDES[framing]
    side_px = _extent(photo) * float(torch.exp(uniform(math.log(low), math.log(high))))
    far = torch.rand((), generator=generator) < _TURNED_FAR
    turn_deg = (
        uniform(-_FAR_TURN_DEG, _FAR_TURN_DEG) if far else _TURN_DEG * torch.randn((), generator=generator)
    )
    shift = uniform(-_SHIFT[framing], _SHIFT[framing], 2)
    crop = Similarity.around(_middle(photo), side_px, float(turn_deg), shift)
    if torch.rand((), generator=generator) < _BUST_BELOW[framing]:
        crop.centre_px[1] = torch.minimum(crop.centre_px[1], torch.tensor(photo.side_px - side_px / 2))
    return crop


def _draw_crop_below(photo: Photo, generator: torch.Generator) -> Similarity:
    """Draw a crop of the body below the head, where badges and folds can look like faces."""
    uniform = Uniform(generator)
    extents = float(uniform(0.5, 1.3))
    x, y = uniform(-0.8, 0.8), 0.75 + uniform(0, 0.6) + extents / 2
    return Similarity.around(_middle(photo), extents * _extent(photo), 0, -torch.stack([x, y]) / extents)


def _draw_crop_aside(photo: Photo, generator: torch.Generator) -> Similarity:
    """Draw a crop beside a face, which lies near its border or is cut by it."""
    uniform = Uniform(generator)
    side_px = _extent(photo) * float(torch.exp(uniform(math.log(2.2), math.log(9))))
    x = (uniform(0.3, 0.6) * (1 - 2 * (torch.rand((), generator=generator) < 0.5).float())).view(1)
    return Similarity.around(_middle(photo), side_px, 0, torch.cat([x, uniform(-0.35, 0.2, 1)]))


def _cropped(photo: Photo, crop: Similarity, side: int, warp: FeatureWarp | None = None) -> ParsingCrops:
    """Resample a photo, with its features moved by `warp`: the image is radiance times alpha over black.

    Below the stored photo its lowest row repeats; that is correct where it shows a garment. Beside it,
    nothing is known about a person who touches the border there.
    """
    positions_px = crop.positions_px(side)
    landmarks_px = photo.landmarks_px
    if warp is not None:
        positions_px, landmarks_px = positions_px + warp.shift(positions_px), warp.shown_at(landmarks_px)
    image = resample(torch.cat([photo.radiance, photo.alpha[None]]), positions_px)
    grid, stored = 2 * positions_px / photo.side_px - 1, photo.label[None, None].float()
    label = F.grid_sample(stored, grid[None], "nearest", "border", align_corners=False)[0, 0]
    beside = (grid[..., 0].abs() > 1) | (grid[..., 1] < -1)
    below = (grid[..., 1] > 1) & (label != class_index("garment"))
    lost = (beside | below) & (image[3] > 0)
    landmarks = crop.in_crop(landmarks_px)
    known = ((landmarks > 0.01) & (landmarks < 0.99)).all(-1)  # false for NaN
    return ParsingCrops(
        crops=image[:3][None],
        alpha=image[3][None],
        label=label.long()[None],
        weight=(~lost).float()[None],
        landmarks=landmarks.nan_to_num(0.5)[None],
        known=known[None],
        present=torch.ones(1),
    )


def _extent(photo: Photo) -> float:
    """Return the larger side of the bounds of the 68 landmarks, in stored pixels."""
    face = photo.landmarks_px[:68]
    return float((face.amax(0) - face.amin(0)).max())


def _middle(photo: Photo) -> Tensor:
    face = photo.landmarks_px[:68]
    return (face.amax(0) + face.amin(0)) / 2


def _without_person(crop: ParsingCrops) -> ParsingCrops:
    return replace(
        crop,
        crops=torch.zeros_like(crop.crops),
        alpha=torch.zeros_like(crop.alpha),
        weight=torch.ones_like(crop.weight),
        known=torch.zeros_like(crop.known),
        present=torch.zeros(1),
    )


def _bordered(crop: ParsingCrops, generator: torch.Generator) -> ParsingCrops:
    """End the photo somewhere in the crop; its border repeats beyond, like in `parse.Square.cut`."""
    side = crop.alpha.shape[-1]
    ends = [int(float(end) * side) for end in Uniform(generator)(0, 0.18, 4)]
    at = torch.arange(side)
    rows, columns = at.clamp(ends[0], side - 1 - ends[1]), at.clamp(ends[2], side - 1 - ends[3])
    inside = ((rows == at)[:, None] & (columns == at)).float()
    x, y = (crop.landmarks[0] * side).long().clamp(0, side - 1).unbind(-1)
    return replace(
        crop,
        crops=crop.crops[..., rows, :][..., columns],
        weight=crop.weight * inside,
        known=crop.known & (inside[y, x] > 0)[None],
    )


def _with_decoys(image: Tensor, crop: ParsingCrops, generator: torch.Generator) -> Tensor:
    """Lay shapes with the person's own colours and texture over a background [3, S, S].

    Behind real people stand things as dark as their hair and as white as their collars. A decoy shows the
    person's image, turned and scaled, so neither colour nor texture tells it from the person. Half of them
    touch the person's outline, where they are most easily mistaken for hair.
    """
    uniform, side = Uniform(generator), crop.alpha.shape[-1]
    person = torch.cat([crop.crops[0], crop.alpha])
    outline = _outline(crop.alpha[0])
    for _ in range(int(torch.randint(1, _DECOYS + 1, (), generator=generator))):
        matrix = rotation_2d(float(uniform(-math.pi, math.pi))) * torch.exp(uniform(-1.0, 0.3))
        grid = (2 * texel_centres_uv(side) - 1) @ matrix.T + uniform(-0.8, 0.8, 2)
        shown = F.grid_sample(person[None], grid[None], padding_mode="reflection", align_corners=False)[0]
        place = uniform(0, 1, 2)
        if len(outline) and torch.rand((), generator=generator) < _TOUCHING:
            place = outline[int(torch.randint(len(outline), (), generator=generator))]
        cover = shape(place, side, generator) * shown[3:]
        colours = shown[:3] / shown[3:].clamp_min(1e-3) * torch.exp(uniform(-0.4, 0.4))
        image = image + cover * (colours - image)
    return image


def _outline(alpha: Tensor) -> Tensor:
    """Return positions [N, 2] in sides, (x, y), of the pixels just off a person of `alpha` [S, S]."""
    person = (alpha > 0.5).float()[None, None]
    around = F.max_pool2d(person, 5, 1, 2) - person
    return (around[0, 0].nonzero().flip(-1) + PIXEL_CENTRE) / alpha.shape[-1]
