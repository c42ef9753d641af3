"""Training crops for the Parsing Network: stored photos of synthetic people, altered for every sample.

A stored photo (`portraits.py`) is mirrored or not, turned, scaled and shifted in the crop, over a background,
sometimes with another person in it or something before the face. A camera then degrades it. Wide variation is
what makes training on synthetic people serve for real ones (Wood et al., *Fake it till you make it*, 2021).

Synthetic people have brows and lips at the same places of one mesh, and a network could guess them from the
rest of the face. So most faces are warped: real brows lie higher or lower, real lips are thinner or thicker.
"""

import io
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from PIL import Image
from safetensors import safe_open
from torch import Tensor

from facerf_cli.image.colour import linear_to_srgb
from facerf_cli.network.inputs import Batch
from facerf_cli.portrait.parse import MIRROR, class_index
from facerf_cli.raster.camera import PIXEL_CENTRE
from facerf_cli.raster.texture import texel_centres_uv
from facerf_cli.synth.bank import files_in, split_people
from facerf_cli.synth.bank.face_crops import gaussian_blurred, turned
from facerf_cli.synth.bank.portraits import background_of
from facerf_cli.synth.random_fields import Uniform

_FEATURES = (slice(17, 22), slice(22, 27), slice(27, 36), slice(36, 42), slice(42, 48), slice(48, 68))
_REACHES = (0.10, 0.10, 0.12, 0.08, 0.08, 0.13)  # standard deviations, in extents of the 68 landmarks
_MOVE_STD = 0.02  # in extents
_STRETCH_STD = 0.15
_MOST = 2.0  # standard deviations; beyond it a warp could fold
_ROUNDS = 8  # of the search for the place that is taken from another; each lowers its error threefold


@dataclass(frozen=True)
class FeatureWarp:
    """A smooth warp of the plane: what is shown at p is taken from p + `shift(p)`; all in pixels.

    Of each of K features: its centre [K, 2] and reach [K], how far it moves [K, 2], and how much it is
    stretched [K, 2] along x and y.
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
        """Places at which those at [..., 2] are shown, the inverse of the warp."""
        shown = places
        for _ in range(_ROUNDS):
            shown = places - self.shift(shown)
        return shown


# Shares of samples: without a person, of a body without its head, grey, turned far, with a second person, and
# with something before the face; of a face whose features were moved; with decoys behind the person.
_EMPTY, _HEADLESS, _GREY, _TURNED_FAR, _SECOND, _OCCLUDED = 0.06, 0.05, 0.25, 0.15, 0.3, 0.25
_WARPED, _DECOYED = 0.75, 0.6
_DECOYS, _TOUCHING = 8, 0.5  # behind a person at most; share of them that touch the person's outline
_TURN_DEG, _FAR_TURN_DEG = 12.0, 50.0  # standard deviation of the turn; largest of the far ones
# Sides of the crop in extents of the landmarks: of the face, of the portrait, of a whole photo; their shares.
_SIDES, _SIDE_SHARES = ((1.25, 2.2), (2.4, 4.6), (4.6, 10.0)), (0.4, 0.4, 0.2)
_SHIFT = (0.08, 0.12, 0.24)  # largest distance of the face from the crop's centre, in sides, for these
_BORDERED = 0.2  # share of crops that reach beyond the photo, where its border goes on
_BUST_BELOW = (0.8, 0.6, 0.3)  # share of crops of each side that end where the stored photo ends, or above


@dataclass(frozen=True)
class PortraitCrops(Batch):
    """Crops of B photos as a screen shows them, and what the Parsing Network should see in them."""

    crops: Tensor  # [B, 3, S, S] in 0..1
    alpha: Tensor  # [B, S, S] in 0..1
    label: Tensor  # [B, S, S] long, class of what is covered
    weight: Tensor  # [B, S, S], 0 where the truth is unknown
    landmarks: Tensor  # [B, N, 2] in sides of the crop
    known: Tensor  # [B, N] whether a landmark is in the crop
    present: Tensor  # [B] whether there is a person


@dataclass(frozen=True, eq=False)
class _Photo:
    """One stored photo: radiance [3, P, P] times alpha, alpha [P, P], label [P, P], landmarks [N, 2]."""

    radiance: Tensor
    alpha: Tensor
    label: Tensor
    landmarks_px: Tensor

    @property
    def side_px(self) -> int:
        return self.alpha.shape[-1]

    def mirrored(self) -> "_Photo":
        flipped = self.landmarks_px[torch.from_numpy(MIRROR)] * torch.tensor([-1.0, 1.0])
        moved = flipped + torch.tensor([float(self.side_px), 0.0])
        return _Photo(self.radiance.flip(-1), self.alpha.flip(-1), self.label.flip(-1), moved)


class StoredPortraits:
    """The bank's photos, read when they are drawn."""

    def __init__(self, folder: Path, backgrounds: Tensor, provenance: dict[str, Any]) -> None:
        self.paths = files_in(folder, "no portraits; make them with `facerf train --stage parsing`")
        self.backgrounds = backgrounds
        self.provenance = provenance

    def people(self, held_out: int) -> tuple[list[int], list[int]]:
        """See `split_people`."""
        return split_people(len(self.paths), held_out)

    def draw(self, people: Sequence[int], side: int, generator: torch.Generator) -> PortraitCrops:
        """Draw one crop [1, ...] of one of some people."""
        photo = self._photo(people, generator)
        headless = torch.rand((), generator=generator) < _HEADLESS
        move = _Placement.below(photo, generator) if headless else _Placement.draw(photo, generator)
        warp = None
        if not headless and torch.rand((), generator=generator) < _WARPED:
            warp = FeatureWarp.draw(photo.landmarks_px[:68], generator)
        crop = move.crop(photo, side, warp)
        if headless:
            crop = replace(crop, known=torch.zeros_like(crop.known), present=torch.zeros(1))
        if torch.rand((), generator=generator) < _EMPTY:
            crop = _without_person(crop)
        image = self._composed(crop, people, side, generator)
        if torch.rand((), generator=generator) < _OCCLUDED:
            cover = _occluder(crop, generator)
            other = self._background(side, generator)
            image = image + cover * (other - image)
            crop = replace(crop, alpha=crop.alpha * (1 - cover))
        crop = replace(crop, crops=_as_taken(image, generator)[None])
        return _bordered(crop, generator) if torch.rand((), generator=generator) < _BORDERED else crop

    def _photo(self, people: Sequence[int], generator: torch.Generator) -> _Photo:
        """Read a random photo of one of some people, mirrored or not."""
        path = self.paths[people[int(torch.randint(len(people), (), generator=generator))]]
        with safe_open(path, framework="pt") as file:
            views, photos = file.get_slice("pictures").get_shape()[:2]
            view, picture = (int(torch.randint(count, (), generator=generator)) for count in (views, photos))
            stored = file.get_slice("pictures")[view, picture]
            alpha, label = (file.get_slice(name)[view] for name in ("alpha", "label"))
            landmarks_px = file.get_slice("landmarks_px")[view]
        photo = _Photo((stored.float() / 255).square(), alpha.float() / 255, label, landmarks_px)
        return photo.mirrored() if torch.rand((), generator=generator) < 0.5 else photo

    def _background(self, side: int, generator: torch.Generator) -> Tensor:
        """Draw a background [3, side, side]."""
        stored = self.backgrounds[int(torch.randint(len(self.backgrounds), (), generator=generator))]
        return background_of(stored, side, generator)

    def _composed(
        self, crop: PortraitCrops, people: Sequence[int], side: int, generator: torch.Generator
    ) -> Tensor:
        """Place the crop's person over a background, and perhaps before another person: [3, side, side]."""
        image = self._background(side, generator)
        if torch.rand((), generator=generator) < _SECOND:
            other = self._photo(people, generator)
            behind = _Placement.aside(other, generator).crop(other, side)
            cover = behind.alpha * (behind.weight > 0)
            blur_px = float(4 * Uniform(generator)(0, 1) ** 2)
            shown, cover = (
                gaussian_blurred(x, blur_px) for x in (behind.crops[0] * (behind.weight > 0), cover)
            )
            image = shown + (1 - cover) * image
        if torch.rand((), generator=generator) < _DECOYED:
            image = _with_decoys(image, crop, generator)
        return crop.crops[0] + (1 - crop.alpha) * image


@dataclass(frozen=True)
class _Placement:
    """A similarity from the crop to a stored photo: place [2] = at [2, 2] @ (x - 0.5) + centre, in pixels."""

    matrix: Tensor
    centre: Tensor

    @staticmethod
    def draw(photo: _Photo, generator: torch.Generator) -> "_Placement":
        """Draw how a crop lies around a face."""
        uniform = Uniform(generator)
        framing = int(torch.multinomial(torch.tensor(_SIDE_SHARES), 1, generator=generator))
        low, high = _SIDES[framing]
        side_px = _extent(photo) * float(torch.exp(uniform(math.log(low), math.log(high))))
        far = torch.rand((), generator=generator) < _TURNED_FAR
        degrees = (
            uniform(-_FAR_TURN_DEG, _FAR_TURN_DEG)
            if far
            else _TURN_DEG * torch.randn((), generator=generator)
        )
        matrix = _turn(math.radians(float(degrees))) * side_px
        shift = uniform(-_SHIFT[framing], _SHIFT[framing], 2)
        centre = _middle(photo) - matrix @ shift
        if torch.rand((), generator=generator) < _BUST_BELOW[framing]:
            centre[1] = torch.minimum(centre[1], torch.tensor(photo.side_px - side_px / 2))
        return _Placement(matrix, centre)

    @staticmethod
    def below(photo: _Photo, generator: torch.Generator) -> "_Placement":
        """Draw a crop of the body below the head, where badges and folds can look like faces."""
        uniform = Uniform(generator)
        extent_px = _extent(photo)
        side_px = float(uniform(0.5, 1.3)) * extent_px
        x, y = uniform(-0.8, 0.8), 0.75 + uniform(0, 0.6) + side_px / extent_px / 2
        return _Placement(torch.eye(2) * side_px, _middle(photo) + extent_px * torch.stack([x, y]))

    @staticmethod
    def aside(photo: _Photo, generator: torch.Generator) -> "_Placement":
        """Draw how a crop lies beside a face that is near its border or cut by it."""
        uniform = Uniform(generator)
        matrix = torch.eye(2) * _extent(photo) * float(torch.exp(uniform(math.log(2.2), math.log(9))))
        x = (uniform(0.3, 0.6) * (1 - 2 * (torch.rand((), generator=generator) < 0.5).float())).view(1)
        return _Placement(matrix, _middle(photo) - matrix @ torch.cat([x, uniform(-0.35, 0.2, 1)]))

    def crop(self, photo: _Photo, side: int, warp: FeatureWarp | None = None) -> PortraitCrops:
        """Resample a photo, its features perhaps moved: the image is radiance times alpha over black.

        Below the stored photo its lowest row goes on, and is true where it shows a garment. Beside it nothing
        is known of a person who touches the border there.
        """
        place = (texel_centres_uv(side) - 0.5) @ self.matrix.T + self.centre
        landmarks_px = photo.landmarks_px
        if warp is not None:
            place, landmarks_px = place + warp.shift(place), warp.shown_at(landmarks_px)
        grid = 2 * place / photo.side_px - 1
        stored = torch.cat([photo.radiance, photo.alpha[None]])[None]
        smaller = float(self.matrix.norm()) / 2**0.5 / side  # stored pixels in a pixel
        if smaller > 1.5:
            stored = F.avg_pool2d(stored, round(smaller), ceil_mode=True, count_include_pad=False)
        seen = F.grid_sample(stored, grid[None], padding_mode="border", align_corners=False)[0]
        label = F.grid_sample(
            photo.label[None, None].float(), grid[None], "nearest", "border", align_corners=False
        )[0, 0]
        beside = (grid[..., 0].abs() > 1) | (grid[..., 1] < -1)
        below = (grid[..., 1] > 1) & (label != class_index("garment"))
        lost = (beside | below) & (seen[3] > 0)
        landmarks = (landmarks_px - self.centre) @ torch.linalg.inv(self.matrix).T + 0.5
        known = ((landmarks > 0.01) & (landmarks < 0.99)).all(-1)  # false for NaN
        return PortraitCrops(
            crops=seen[:3][None],
            alpha=seen[3][None],
            label=label.long()[None],
            weight=(~lost).float()[None],
            landmarks=landmarks.nan_to_num(0.5)[None],
            known=known[None],
            present=torch.ones(1),
        )


def _extent(photo: _Photo) -> float:
    """Larger side of the bounds of the 68 landmarks, in stored pixels."""
    face = photo.landmarks_px[:68]
    return float((face.amax(0) - face.amin(0)).max())


def _middle(photo: _Photo) -> Tensor:
    face = photo.landmarks_px[:68]
    return (face.amax(0) + face.amin(0)) / 2


def _turn(radians: float) -> Tensor:
    cos, sin = math.cos(radians), math.sin(radians)
    return torch.tensor([[cos, sin], [-sin, cos]])


def _without_person(crop: PortraitCrops) -> PortraitCrops:
    return replace(
        crop,
        crops=torch.zeros_like(crop.crops),
        alpha=torch.zeros_like(crop.alpha),
        weight=torch.ones_like(crop.weight),
        known=torch.zeros_like(crop.known),
        present=torch.zeros(1),
    )


def _bordered(crop: PortraitCrops, generator: torch.Generator) -> PortraitCrops:
    """End the photo somewhere in the crop: from there on its border goes on, as in `parse.Square.cut`."""
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


def _with_decoys(image: Tensor, crop: PortraitCrops, generator: torch.Generator) -> Tensor:
    """Lay shapes with the person's own colours and texture over a background [3, S, S].

    Behind real people stand things as dark as their hair and as white as their collars. A decoy shows the
    person's image, turned and scaled, so neither colour nor texture tells it from the person. Half of them
    touch the person's outline, where they are most easily taken for hair.
    """
    uniform, side = Uniform(generator), crop.alpha.shape[-1]
    person = torch.cat([crop.crops[0], crop.alpha])
    outline = _outline(crop.alpha[0])
    for _ in range(int(torch.randint(1, _DECOYS + 1, (), generator=generator))):
        matrix = _turn(float(uniform(-math.pi, math.pi))) * torch.exp(uniform(-1.0, 0.3))
        grid = (2 * texel_centres_uv(side) - 1) @ matrix.T + uniform(-0.8, 0.8, 2)
        shown = F.grid_sample(person[None], grid[None], padding_mode="reflection", align_corners=False)[0]
        place = uniform(0, 1, 2)
        if len(outline) and torch.rand((), generator=generator) < _TOUCHING:
            place = outline[int(torch.randint(len(outline), (), generator=generator))]
        cover = _shape(place, side, generator) * shown[3:]
        colours = shown[:3] / shown[3:].clamp_min(1e-3) * torch.exp(uniform(-0.4, 0.4))
        image = image + cover * (colours - image)
    return image


def _outline(alpha: Tensor) -> Tensor:
    """Places [N, 2] in sides, (x, y), of the pixels just off a person of `alpha` [S, S]."""
    person = (alpha > 0.5).float()[None, None]
    around = F.max_pool2d(person, 5, 1, 2) - person
    return (around[0, 0].nonzero().flip(-1) + PIXEL_CENTRE) / alpha.shape[-1]


def _occluder(crop: PortraitCrops, generator: torch.Generator) -> Tensor:
    """Draw the cover [S, S] of something before the person, mostly aside."""
    uniform = Uniform(generator)
    angle, distance = uniform(0, 2 * math.pi), uniform(0.1, 0.6)
    centre = 0.5 + distance * torch.stack([angle.cos(), angle.sin()])
    return _shape(centre, crop.alpha.shape[-1], generator)


def _shape(centre: Tensor, side: int, generator: torch.Generator) -> Tensor:
    """Draw the cover [S, S] of an ellipse, a bar or a box around a place [2], in sides."""
    uniform = Uniform(generator)
    long, wide = torch.exp(uniform(-3.2, -0.9)), torch.exp(uniform(-3.5, -1.4))
    tilt = uniform(0, math.pi)
    x, y = (texel_centres_uv(side) - centre).unbind(-1)
    along, across = turned(x, y, tilt)
    a, b = along / long, across / wide
    round_one = torch.rand((), generator=generator) < 0.5
    distance = a.square() + b.square() if round_one else torch.maximum(a.abs(), b.abs()) ** 2
    return ((1 - distance) * side * float(torch.minimum(long, wide)) / 2 + 0.5).clamp(0, 1)


def _as_taken(image: Tensor, generator: torch.Generator) -> Tensor:
    """Take a photo of a scene [3, S, S]: colour cast, exposure, blur, tone curve, noise, JPEG; in 0..1."""
    uniform = Uniform(generator)
    image = image * torch.exp(uniform(-0.25, 0.25, 3, 1, 1))
    if torch.rand((), generator=generator) < _GREY:
        image = image.mean(0, keepdim=True).expand(3, -1, -1)
    white = torch.exp(uniform(0.3, 2.2)) * image.mean().clamp_min(1e-4)
    image = (image / white).clamp(0, 1)
    if torch.rand((), generator=generator) < 0.5:
        image = gaussian_blurred(image, float(uniform(0, 1) ** 2 * 2.5))
    encoded = torch.from_numpy(linear_to_srgb(image.numpy())) ** torch.exp(uniform(-0.45, 0.45))
    encoded = ((encoded - 0.5) * uniform(0.7, 1.15) + 0.5 + uniform(-0.08, 0.08)).clamp(0, 1)
    encoded = encoded + uniform(0, 1) ** 3 * 0.12 * torch.randn(encoded.shape, generator=generator)
    encoded = encoded.clamp(0, 1)
    if torch.rand((), generator=generator) < 0.4:
        return _jpeg(encoded, int(uniform(15, 95)))
    return encoded


def _jpeg(image: Tensor, quality: int) -> Tensor:
    """Compress and restore an image [3, S, S] in 0..1."""
    pixels = (255 * image).round().byte().permute(1, 2, 0).numpy()
    buffer = io.BytesIO()
    Image.fromarray(pixels).save(buffer, "JPEG", quality=quality)
    return torch.from_numpy(np.array(Image.open(buffer))).permute(2, 0, 1).float() / 255
