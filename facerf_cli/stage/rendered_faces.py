"""Training crops for the Geometry Network: the bank's pictures as photographs, drawn anew for every sample.

A stored picture (`stage.face_pictures`) is mirrored or not, turned, shifted and scaled in the crop; a
background comes behind it and something may hide a part of it; then a camera takes it, as careless as
photographers are. The pose that belongs to the crop follows every move.
"""

import math
from dataclasses import dataclass, fields
from functools import cache
from pathlib import Path
from typing import Any

import torch
import torch.nn.functional as F
from safetensors.torch import load_file
from torch import Tensor

from facerf_cli.errors import InputError
from facerf_cli.face.morphable import load_face_model
from facerf_cli.face.topology import GRID, MIRROR_68
from facerf_cli.raster.camera import CROP_FOCAL_PER_SIDE, PIXEL_CENTRE
from facerf_cli.stage.draws import Uniform
from facerf_cli.stage.face_pictures import PictureSettings

_PICTURES = PictureSettings()
_FACE_DEPTH_M = 0.11  # of the face before the head frame's origin
_OCCLUDED, _GREY, _TURNED = 0.3, 0.25, 0.5  # shares of samples
_TURN_DEG, _SHIFT, _SCALE = 15.0, 0.02, 0.04  # shift as a share of the crop's side, scale of the logarithm


@dataclass(frozen=True)
class FaceCrops:
    """Crops of B faces, scene-linear at any exposure, with the fit that should be found in them."""

    crops: Tensor  # [B, 3, S, S]
    landmarks_px: Tensor  # [B, 68, 2], the true ones, also where they are hidden
    rotation: Tensor  # [B, 3, 3] head_to_camera
    translation_m: Tensor  # [B, 3]
    alpha: Tensor  # [B, Ki] of the built-in model
    beta: Tensor  # [B, Ke]

    def to(self, device: torch.device) -> "FaceCrops":
        """The same crops on `device`."""
        return FaceCrops(*(getattr(self, field.name).to(device) for field in fields(self)))


class RenderedFaces:
    """The pictures of a bank's heads, held in memory as bytes, from which crops are drawn."""

    def __init__(
        self,
        folder: Path,
        provenance: dict[str, Any],
        settings: PictureSettings = _PICTURES,
    ) -> None:
        paths = sorted(folder.glob("*.safetensors"))
        if not paths:
            raise InputError(f"{folder}: no pictures of heads; let `facerf train --stage geometry` make them")
        self.provenance = provenance
        self.settings = settings
        self.pictures = [load_file(path) for path in paths]

    def heads(self, held_out: int) -> tuple[Tensor, Tensor]:
        """Indices of the heads to train on, and of the first `held_out` after the mean face."""
        return torch.arange(held_out + 1, len(self.pictures)), torch.arange(1, held_out + 1)

    def mean_translation_m(self) -> tuple[float, float, float]:
        """Mean translation of all heads, where the network starts from."""
        x, y, z = torch.cat([head["translation_m"] for head in self.pictures]).mean(0).tolist()
        return x, y, z

    def draw(self, head: int, side: int, generator: torch.Generator) -> FaceCrops:
        """One crop of a head, of that many pixels along each side."""
        stored = self.pictures[head]
        index = int(torch.randint(len(stored["pictures"]), (), generator=generator))
        own = {name: tensor[index] for name, tensor in stored.items()}
        if torch.rand((), generator=generator) < 0.5:
            own = _mirrored(own, self.settings.crop_px)
        move = _Move.draw(generator)
        crop = move.picture(own["pictures"], side, self.settings)
        rotation, translation_m = move.pose(own["rotation"], own["translation_m"])
        return FaceCrops(
            _photographed(_composed(crop, generator), generator)[None],
            side * move.points(own["landmarks_px"] / self.settings.crop_px)[None],
            rotation[None],
            translation_m[None],
            own["alpha"][None],
            own["beta"][None],
        )


def _mirrored(own: dict[str, Tensor], crop_px: int) -> dict[str, Tensor]:
    """The same head seen in a mirror."""
    flip = torch.tensor([-1.0, 1.0, 1.0])
    by_alpha, by_beta = _mirrored_coefficients()
    landmarks_px = own["landmarks_px"][torch.from_numpy(MIRROR_68)] * flip[:2]
    return {
        "pictures": own["pictures"].flip(-1),
        "landmarks_px": landmarks_px + torch.tensor([float(crop_px), 0.0]),
        "rotation": flip[:, None] * own["rotation"] * flip,
        "translation_m": flip * own["translation_m"],
        "alpha": own["alpha"] @ by_alpha,
        "beta": own["beta"] @ by_beta,
    }


@cache
def _mirrored_coefficients() -> tuple[Tensor, Tensor]:
    """[Ki, Ki] and [Ke, Ke] that turn the built-in model's coefficients into those of the mirror image."""
    model = load_face_model()
    maps = []
    for basis in (model.identity, model.expression):
        mirrored = basis.view(-1, GRID, GRID, 3).flip(2) * torch.tensor([-1.0, 1.0, 1.0])
        flat, image = basis.flatten(1).double(), mirrored.flatten(1).double()
        maps.append((image @ flat.T @ torch.linalg.pinv(flat @ flat.T)).float())
    return maps[0], maps[1]


@dataclass(frozen=True)
class _Move:
    """A turn about the crop's middle, then a scale and a shift in units of its side."""

    angle: float  # radians, counter-clockwise on screen
    scale: float
    shift: Tensor  # [2], to the right and down

    @staticmethod
    def draw(generator: torch.Generator) -> "_Move":
        turned = bool(torch.rand((), generator=generator) < _TURNED)
        angle = math.radians(_TURN_DEG) * (2 * float(torch.rand((), generator=generator)) - 1) * turned
        scale = math.exp(_SCALE * float(torch.randn((), generator=generator).clamp(-2, 2)))
        return _Move(angle, scale, _SHIFT * torch.randn(2, generator=generator).clamp(-2, 2))

    def _matrix(self) -> Tensor:
        """[2, 2] on (right, down)."""
        cos, sin = math.cos(self.angle), math.sin(self.angle)
        return self.scale * torch.tensor([[cos, sin], [-sin, cos]])

    def points(self, share: Tensor) -> Tensor:
        """Where points [N, 2], as shares of the crop's side, go."""
        return (share - 0.5) @ self._matrix().T + 0.5 + self.shift

    def picture(self, stored: Tensor, side: int, settings: PictureSettings) -> Tensor:
        """The moved crop [4, side, side] of a stored picture [4, P, P]: linear colour and cover."""
        centre = (torch.arange(side) + PIXEL_CENTRE) / side
        y, x = torch.meshgrid(centre, centre, indexing="ij")
        source = (torch.stack([x, y], -1) - 0.5 - self.shift) @ torch.linalg.inv(self._matrix()).T + 0.5
        whole_px = settings.crop_px + 2 * settings.margin_px
        grid = 2 * (source * settings.crop_px + settings.margin_px) / whole_px - 1
        linear = stored.float() / 255
        linear[:3] *= linear[:3]
        return F.grid_sample(linear[None], grid[None], align_corners=False)[0]

    def pose(self, rotation: Tensor, translation_m: Tensor) -> tuple[Tensor, Tensor]:
        """The pose in the crop camera after the move; shift and scale as they act on the face's own depth."""
        cos, sin = math.cos(self.angle), math.sin(self.angle)
        turn = torch.tensor([[cos, -sin, 0], [sin, cos, 0], [0, 0, 1.0]])
        turned = turn @ translation_m
        before_m = -turned[2] - _FACE_DEPTH_M
        after_m = before_m / self.scale
        offset_m = self.shift * torch.tensor([1.0, -1.0]) * after_m / CROP_FOCAL_PER_SIDE
        return turn @ rotation, torch.cat([turned[:2] + offset_m, -(after_m + _FACE_DEPTH_M)[None]])


def _composed(crop: Tensor, generator: torch.Generator) -> Tensor:
    """A crop [4, S, S] before a random background, and in some behind a random thing: [3, S, S]."""
    side = crop.shape[-1]
    picture = crop[:3] + (1 - crop[3:]) * _texture(side, generator)
    if torch.rand((), generator=generator) < _OCCLUDED:
        hidden = _patch(side, generator)
        picture = picture + hidden * (_texture(side, generator) - picture)
    return picture


def _texture(side: int, generator: torch.Generator) -> Tensor:
    """Random colours [3, S, S]: even, or blotches and strokes of a random size, or with straight edges."""
    uniform = Uniform(generator)
    colour = torch.exp(uniform(-4.5, -0.5) + 0.35 * torch.randn(3, 1, 1, generator=generator))
    cells = torch.randint(2, 40, (2,), generator=generator).tolist()
    contrast = uniform(0, 1) ** 2 * 1.2
    grey = torch.randn(1, 1, *cells, generator=generator) + 0.4 * torch.randn(
        1, 3, *cells, generator=generator
    )
    hard = bool(torch.rand((), generator=generator) < 0.3)
    field = (
        F.interpolate(grey, (side, side), mode="nearest")
        if hard
        else F.interpolate(grey, (side, side), mode="bilinear", align_corners=False)
    )
    return colour * torch.exp(contrast * field[0])


def _patch(side: int, generator: torch.Generator) -> Tensor:
    """Cover [1, S, S] by an ellipse that lies mostly toward the crop's border."""
    uniform = Uniform(generator)
    angle, distance = uniform(0, 2 * math.pi), uniform(0.3, 0.6)
    centre = 0.5 + distance * torch.stack([angle.cos(), angle.sin()])
    radii, tilt = uniform(0.06, 0.22, 2), uniform(0, math.pi)
    along = (torch.arange(side) + PIXEL_CENTRE) / side
    y, x = torch.meshgrid(along - centre[1], along - centre[0], indexing="ij")
    a, b = x * tilt.cos() + y * tilt.sin(), y * tilt.cos() - x * tilt.sin()
    return ((1 - (a / radii[0]) ** 2 - (b / radii[1]) ** 2) * 8 + 0.5).clamp(0, 1)[None]


def _photographed(picture: Tensor, generator: torch.Generator) -> Tensor:
    """What a camera makes of a linear picture [3, S, S]: colour cast, clipping, blur, tone curve, noise."""
    uniform = Uniform(generator)
    picture = picture * torch.exp(uniform(-0.2, 0.2, 3, 1, 1))
    if torch.rand((), generator=generator) < _GREY:
        picture = picture.mean(0, keepdim=True).expand(3, -1, -1)
    clip = uniform(1.6, 6.0) * picture.mean().clamp_min(1e-4)
    picture = (picture / clip).clamp(0, 1)
    picture = _blurred(picture, float(uniform(0, 1.3))) ** torch.exp(uniform(-0.3, 0.3))
    noise = torch.randn(picture.shape, generator=generator) * uniform(0, 0.04) ** 1.2
    return (picture + noise * (picture + 0.02).sqrt()).clamp(0, 1)


def _blurred(picture: Tensor, sigma_px: float) -> Tensor:
    """A picture [3, S, S] under a Gaussian; as two products, which is quickest at this size."""
    at = torch.arange(picture.shape[-1])
    kernel = torch.exp(-0.5 * ((at[:, None] - at) / max(sigma_px, 0.05)) ** 2)
    kernel = kernel / kernel.sum(1, keepdim=True)
    return kernel @ picture @ kernel.T
