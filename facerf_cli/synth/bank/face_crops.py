"""Training crops for the Geometry Network: stored images of heads, augmented at random for every sample.

A stored image (`head_images.py`) is mirrored or not, rotated, shifted and scaled in the crop. A background
and sometimes an occluder are added, and a camera model degrades the result. The pose follows every move.
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
from facerf_cli.synth.bank.head_images import ImageSettings
from facerf_cli.synth.random_fields import Uniform

_IMAGES = ImageSettings()
_FACE_DEPTH_M = 0.11  # distance from the face back to the origin of the head frame
_OCCLUDED, _GREY, _TURNED = 0.3, 0.25, 0.5  # shares of samples that are occluded, grey, rotated
_TURN_DEG = 15.0  # largest turn
# Standard deviations of the shift to the right and down (sides) and of log scale: a crop is cut around a
# detector's box, see `dataset/crops.py`.
_SHIFT, _SCALE = (0.1, 0.03), 0.07


@dataclass(frozen=True)
class FaceCrops:
    """Crops of B faces as a camera gives them, and the fit that the network should find in them."""

    crops: Tensor  # [B, 3, S, S]
    landmarks_px: Tensor  # [B, 68, 2] true positions, also of hidden ones
    rotation: Tensor  # [B, 3, 3] head_to_camera
    translation_m: Tensor  # [B, 3]
    alpha: Tensor  # [B, Ki] of the built-in model
    beta: Tensor  # [B, Ke]

    def to(self, device: torch.device) -> "FaceCrops":
        """Move the crops to `device`."""
        return FaceCrops(*(getattr(self, field.name).to(device) for field in fields(self)))


class RenderedFaces:
    """Images of the bank's heads, held in memory as bytes, from which crops are drawn."""

    def __init__(
        self,
        folder: Path,
        provenance: dict[str, Any],
        settings: ImageSettings = _IMAGES,
    ) -> None:
        paths = sorted(folder.glob("*.safetensors"))
        if not paths:
            raise InputError(f"{folder}: no images of heads; make them with `facerf train --stage geometry`")
        self.provenance = provenance
        self.settings = settings
        self.images = [load_file(path) for path in paths]

    def heads(self, held_out: int) -> tuple[Tensor, Tensor]:
        """Indices of the training heads, and of the first `held_out` heads after the mean face."""
        return torch.arange(held_out + 1, len(self.images)), torch.arange(1, held_out + 1)

    def mean_translation_m(self) -> tuple[float, float, float]:
        """Mean translation of all images, the starting point of the network."""
        x, y, z = torch.cat([head["translation_m"] for head in self.images]).mean(0).tolist()
        return x, y, z

    def draw(self, head: int, side: int, generator: torch.Generator) -> FaceCrops:
        """Draw one crop of a head, [1, 3, side, side], with its fit."""
        images = self.images[head]
        index = int(torch.randint(len(images["pictures"]), (), generator=generator))
        stored = {name: tensor[index] for name, tensor in images.items()}
        if torch.rand((), generator=generator) < 0.5:
            stored = _mirrored(stored, self.settings.crop_px)
        move = _Move.draw(generator)
        crop = move.image(stored["pictures"], side, self.settings)
        rotation, translation_m = move.pose(stored["rotation"], stored["translation_m"])
        return FaceCrops(
            _with_camera_errors(_composed(crop, generator), generator)[None],
            side * move.points(stored["landmarks_px"] / self.settings.crop_px)[None],
            rotation[None],
            translation_m[None],
            stored["alpha"][None],
            stored["beta"][None],
        )


def _mirrored(stored: dict[str, Tensor], crop_px: int) -> dict[str, Tensor]:
    """Mirror a stored image and its fit."""
    flip = torch.tensor([-1.0, 1.0, 1.0])
    to_alpha, to_beta = _mirrored_coefficients()
    landmarks_px = stored["landmarks_px"][torch.from_numpy(MIRROR_68)] * flip[:2]
    return {
        "pictures": stored["pictures"].flip(-1),
        "landmarks_px": landmarks_px + torch.tensor([float(crop_px), 0.0]),
        "rotation": flip[:, None] * stored["rotation"] * flip,
        "translation_m": flip * stored["translation_m"],
        "alpha": stored["alpha"] @ to_alpha,
        "beta": stored["beta"] @ to_beta,
    }


@cache
def _mirrored_coefficients() -> tuple[Tensor, Tensor]:
    """Matrices [Ki, Ki] and [Ke, Ke] from the built-in model's coefficients to those of the mirrored face."""
    model = load_face_model()
    maps = []
    for basis in (model.identity, model.expression):
        mirrored = basis.view(-1, GRID, GRID, 3).flip(2) * torch.tensor([-1.0, 1.0, 1.0])
        flat, image = basis.flatten(1).double(), mirrored.flatten(1).double()
        maps.append((image @ flat.T @ torch.linalg.pinv(flat @ flat.T)).float())
    return maps[0], maps[1]


@dataclass(frozen=True)
class _Move:
    """A similarity of the crop: rotation and scale about its centre, then a shift in units of its side."""

    angle: float  # radians, counter-clockwise on screen
    scale: float
    shift: Tensor  # [2] right and down

    @staticmethod
    def draw(generator: torch.Generator) -> "_Move":
        """Draw a random move."""
        turned = bool(torch.rand((), generator=generator) < _TURNED)
        angle = math.radians(_TURN_DEG) * (2 * float(torch.rand((), generator=generator)) - 1) * turned
        scale = math.exp(_SCALE * float(torch.randn((), generator=generator).clamp(-2, 2)))
        shift = torch.tensor(_SHIFT) * torch.randn(2, generator=generator).clamp(-2, 2)
        return _Move(angle, scale, shift)

    def _matrix(self) -> Tensor:
        """Rotation and scale [2, 2] of (right, down)."""
        cos, sin = math.cos(self.angle), math.sin(self.angle)
        return self.scale * torch.tensor([[cos, sin], [-sin, cos]])

    def points(self, share: Tensor) -> Tensor:
        """Move points [N, 2], in units of the crop's side."""
        return (share - 0.5) @ self._matrix().T + 0.5 + self.shift

    def image(self, stored: Tensor, side: int, settings: ImageSettings) -> Tensor:
        """Resample a stored image [4, P, P] to a crop [4, side, side] of linear colour and cover."""
        centre = (torch.arange(side) + PIXEL_CENTRE) / side
        y, x = torch.meshgrid(centre, centre, indexing="ij")
        source = (torch.stack([x, y], -1) - 0.5 - self.shift) @ torch.linalg.inv(self._matrix()).T + 0.5
        whole_px = settings.crop_px + 2 * settings.margin_px
        grid = 2 * (source * settings.crop_px + settings.margin_px) / whole_px - 1
        linear = stored.float() / 255
        linear[:3] *= linear[:3]
        return F.grid_sample(linear[None], grid[None], align_corners=False)[0]

    def pose(self, rotation: Tensor, translation_m: Tensor) -> tuple[Tensor, Tensor]:
        """Move the pose with the crop; shift and scale are exact at the depth of the face."""
        cos, sin = math.cos(self.angle), math.sin(self.angle)
        turn = torch.tensor([[cos, -sin, 0], [sin, cos, 0], [0, 0, 1.0]])
        turned = turn @ translation_m
        before_m = -turned[2] - _FACE_DEPTH_M
        after_m = before_m / self.scale
        offset_m = self.shift * torch.tensor([1.0, -1.0]) * after_m / CROP_FOCAL_PER_SIDE
        return turn @ rotation, torch.cat([turned[:2] + offset_m, -(after_m + _FACE_DEPTH_M)[None]])


def _composed(crop: Tensor, generator: torch.Generator) -> Tensor:
    """Composite a crop [4, S, S] over a random background, and sometimes under an occluder: [3, S, S]."""
    side = crop.shape[-1]
    image = crop[:3] + (1 - crop[3:]) * _background(side, generator)
    if torch.rand((), generator=generator) < _OCCLUDED:
        hidden = _occluder(side, generator)
        image = image + hidden * (_background(side, generator) - image)
    return image


def _background(side: int, generator: torch.Generator) -> Tensor:
    """Draw a random background [3, S, S]: blotches or rectangles of random size and contrast."""
    uniform = Uniform(generator)
    colour = torch.exp(uniform(-4.5, -0.5) + 0.35 * torch.randn(3, 1, 1, generator=generator))
    cells = torch.randint(2, 40, (2,), generator=generator).tolist()
    contrast = uniform(0, 1) ** 2 * 1.2
    grey = torch.randn(1, 1, *cells, generator=generator) + 0.4 * torch.randn(
        1, 3, *cells, generator=generator
    )
    if torch.rand((), generator=generator) < 0.3:
        field = F.interpolate(grey, (side, side), mode="nearest")
    else:
        field = F.interpolate(grey, (side, side), mode="bilinear", align_corners=False)
    return colour * torch.exp(contrast * field[0])


def _occluder(side: int, generator: torch.Generator) -> Tensor:
    """Draw the cover [1, S, S] of an occluder, an ellipse near the border of the crop."""
    uniform = Uniform(generator)
    angle, distance = uniform(0, 2 * math.pi), uniform(0.3, 0.6)
    centre = 0.5 + distance * torch.stack([angle.cos(), angle.sin()])
    radii, tilt = uniform(0.06, 0.22, 2), uniform(0, math.pi)
    along = (torch.arange(side) + PIXEL_CENTRE) / side
    y, x = torch.meshgrid(along - centre[1], along - centre[0], indexing="ij")
    a, b = x * tilt.cos() + y * tilt.sin(), y * tilt.cos() - x * tilt.sin()
    return ((1 - (a / radii[0]) ** 2 - (b / radii[1]) ** 2) * 8 + 0.5).clamp(0, 1)[None]


def _with_camera_errors(image: Tensor, generator: torch.Generator) -> Tensor:
    """Simulate a camera on a linear image [3, S, S]: colour cast, clipping, blur, tone curve, noise."""
    uniform = Uniform(generator)
    image = image * torch.exp(uniform(-0.2, 0.2, 3, 1, 1))
    if torch.rand((), generator=generator) < _GREY:
        image = image.mean(0, keepdim=True).expand(3, -1, -1)
    clip = uniform(1.6, 6.0) * image.mean().clamp_min(1e-4)
    image = (image / clip).clamp(0, 1)
    image = gaussian_blurred(image, float(uniform(0, 1.3))) ** torch.exp(uniform(-0.3, 0.3))
    noise = torch.randn(image.shape, generator=generator) * uniform(0, 0.04) ** 1.2
    return (image + noise * (image + 0.02).sqrt()).clamp(0, 1)


def gaussian_blurred(image: Tensor, sigma_px: float) -> Tensor:
    """Blur an image [3, S, S] by a Gaussian, as two matrix products: the fastest way at this size."""
    at = torch.arange(image.shape[-1])
    kernel = torch.exp(-0.5 * ((at[:, None] - at) / max(sigma_px, 0.05)) ** 2)
    kernel = kernel / kernel.sum(1, keepdim=True)
    return kernel @ image @ kernel.T
