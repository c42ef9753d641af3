"""Photographs of training samples: the camera's errors, the position of the crop, occluders and backgrounds.

The stages differ in the ranges of these effects; the steps and their order are the same for all.
"""

import io
import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
import torch.nn.functional as F
from PIL import Image
from torch import Tensor

from facerf_cli.image.colour import linear_to_srgb, srgb_to_linear
from facerf_cli.raster.camera import CROP_FOCAL_PER_SIDE
from facerf_cli.raster.texture import texel_centres_uv
from facerf_cli.synth.random_fields import Uniform

_FACE_DEPTH_M = 0.11  # distance from the face back to the origin of the head frame
_BLURRED = 0.7  # fraction of photos, other than a phone's, that are blurred
_JPEG_QUALITY = (15, 95)
_POOLED_PX = 1.5  # pixels are averaged if samples are farther apart


@dataclass(frozen=True)
class SimulatedCamera:
    """Ranges of the errors of a camera, in the order that `colours` and `take` apply them."""

    balance: float = 0.12  # largest log of the gain of a channel
    grey: float = 0.25  # fraction of photos without colours
    white: tuple[float, float] = (1.6, 6.0)  # radiance that is clipped, over the mean
    blur_px: float = 1.8  # largest sigma
    phone: float = 0.0  # fraction of photos that a phone smooths and sharpens
    curve: float = 0.22  # largest log of the exponent of the tone curve
    contrast: tuple[float, float] = (0.0, 0.0)  # weight of an S-shaped curve on displayed values
    lift: float = 0.0  # largest shift of displayed values
    noise: float = 0.03  # largest standard deviation at a radiance of 1
    jpeg: float = 0.0  # fraction of photos that are compressed

    def colours(self, generator: torch.Generator) -> Tensor:
        """Draw the matrix [3, 3] from true colours to the camera's."""
        balance = torch.exp(Uniform(generator)(-self.balance, self.balance, 3))
        grey = torch.rand((), generator=generator) < self.grey
        return (balance / 3).expand(3, 3) if grey else balance.diag()

    def take(self, image: Tensor, mean: Tensor, generator: torch.Generator) -> Tensor:
        """Photograph a linear image [3, S, S], exposed by a mean radiance; return linear values in 0..1."""
        uniform = Uniform(generator)
        white = torch.exp(uniform(math.log(self.white[0]), math.log(self.white[1])))
        image = (image / (white * mean.clamp_min(1e-4))).clamp(0, 1)
        sigma_px = max(self.blur_px * float(uniform(0, 1)) ** 2, 0.05)
        if torch.rand((), generator=generator) < self.phone:
            image = _sharpened(image, uniform)
        elif torch.rand((), generator=generator) < _BLURRED:
            image = gaussian_blurred(image, sigma_px)
        image = image ** torch.exp(uniform(-self.curve, self.curve))
        amount, lift = uniform(*self.contrast), uniform(-self.lift, self.lift)
        if amount or lift:
            root = image.sqrt()  # close to the displayed values
            root = torch.lerp(root, root.square() * (3 - 2 * root), amount) + lift
            image = root.clamp(0, 1).square()
        noise = self.noise * uniform(0, 1) ** 2 * torch.randn(image.shape, generator=generator)
        image = (image + noise * (image + 0.02).sqrt()).clamp(0, 1)
        return _jpeg(image, uniform) if torch.rand((), generator=generator) < self.jpeg else image


def recoloured(images: Tensor, colours: Tensor) -> Tensor:
    """Apply matrices [..., 3, 3] of `SimulatedCamera.colours` to images [..., 3, H, W]."""
    return torch.einsum("...dc,...chw->...dhw", colours, images)


def _sharpened(image: Tensor, uniform: Uniform) -> Tensor:
    """Smooth and sharpen an image [3, S, S] as a phone does."""
    smooth = torch.lerp(image, gaussian_blurred(image, float(uniform(0.8, 2))), uniform(0, 0.8))
    edges = smooth - gaussian_blurred(smooth, float(uniform(0.7, 1.5)))
    return (smooth + uniform(0.3, 1.2) * edges).clamp(0, 1)


def _jpeg(image: Tensor, uniform: Uniform) -> Tensor:
    """Compress and restore a linear image [3, S, S] in 0..1."""
    pixels = (255 * linear_to_srgb(image.permute(1, 2, 0).numpy())).round().astype(np.uint8)
    buffer = io.BytesIO()
    Image.fromarray(pixels).save(buffer, "JPEG", quality=int(uniform(*_JPEG_QUALITY)))
    return torch.from_numpy(srgb_to_linear(np.array(Image.open(buffer)) / np.float32(255))).permute(2, 0, 1)


class Similarity(NamedTuple):
    """Map from a crop to an image: p_px = matrix [2, 2] @ (p - 0.5) + centre_px [2], with p in sides."""

    matrix: Tensor
    centre_px: Tensor

    @staticmethod
    def around(centre_px: Tensor, side_px: float, turn_deg: float, shift: Tensor) -> "Similarity":
        """Place a crop of side_px so that a point of the image lies `shift` [2], in sides, off its middle.

        The image is shown turned by turn_deg, counter-clockwise.
        """
        matrix = side_px * rotation_2d(math.radians(turn_deg))
        return Similarity(matrix, centre_px - matrix @ shift)

    @property
    def side_px(self) -> float:
        """Side of the crop in the image's pixels."""
        return float(self.matrix.norm()) / 2**0.5

    def positions_px(self, side: int) -> Tensor:
        """Return positions [S, S, 2] in the image of the centres of a crop's pixels."""
        return (texel_centres_uv(side) - 0.5) @ self.matrix.T + self.centre_px

    def in_crop(self, points_px: Tensor) -> Tensor:
        """Convert points [N, 2] of the image to sides of the crop."""
        return (points_px - self.centre_px) @ torch.linalg.inv(self.matrix).T + 0.5

    def pose(
        self, centre_px: Tensor, side_px: float, rotation: Tensor, translation_m: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Move a head's pose from an upright crop of the image to this one.

        rotation [3, 3] and translation_m [3] are those through the `crop_camera` of a crop around centre_px.
        Shift and scale are exact at the depth of the face.
        """
        turn = torch.eye(3)
        turn[:2, :2] = self.matrix / self.side_px
        shift = self.in_crop(centre_px[None])[0] - 0.5
        turned = turn @ translation_m
        after_m = (-turned[2] - _FACE_DEPTH_M) * self.side_px / side_px
        offset_m = shift * torch.tensor([1.0, -1.0]) * after_m / CROP_FOCAL_PER_SIDE
        return turn @ rotation, torch.cat([turned[:2] + offset_m, -(after_m + _FACE_DEPTH_M)[None]])


def resample(image: Tensor, positions_px: Tensor) -> Tensor:
    """Sample an image [C, H, H] at positions [S, S, 2] in its pixels: [C, S, S]; distant ones are means."""
    side = len(positions_px)
    step_px = float((positions_px[0, -1] - positions_px[0, 0]).norm()) / (side - 1)
    grid = 2 * positions_px / image.shape[-1] - 1
    if step_px > _POOLED_PX:
        image = F.avg_pool2d(image, round(step_px), ceil_mode=True, count_include_pad=False)
    return F.grid_sample(image[None], grid[None], padding_mode="border", align_corners=False)[0]


def rotation_2d(radians: float) -> Tensor:
    """Return the matrix [2, 2] that turns (right, down) clockwise on screen."""
    cos, sin = math.cos(radians), math.sin(radians)
    return torch.tensor([[cos, -sin], [sin, cos]])


def turned(x: Tensor, y: Tensor, tilt: Tensor) -> tuple[Tensor, Tensor]:
    """Return coordinates along and across a direction that is turned by `tilt` radians."""
    return x * tilt.cos() + y * tilt.sin(), y * tilt.cos() - x * tilt.sin()


def gaussian_blurred(image: Tensor, sigma_px: float) -> Tensor:
    """Blur an image [..., S, S] by a Gaussian, as two matrix products: the fastest way at this size."""
    at = torch.arange(image.shape[-1])
    kernel = torch.exp(-0.5 * ((at[:, None] - at) / max(sigma_px, 0.05)) ** 2)
    kernel = kernel / kernel.sum(1, keepdim=True)
    return kernel @ image @ kernel.T


def background(stored: Tensor, side: int, generator: torch.Generator) -> Tensor:
    """Draw a background [3, side, side]: a part of one of a bank, blurred by a lens, at any exposure.

    stored [N, 3, S, S] uint8 comes from `load_backgrounds`.
    """
    uniform = Uniform(generator)
    chosen = stored[int(torch.randint(len(stored), (), generator=generator))]
    reach = float(uniform(0.25, 1.0))
    centre = (1 - reach) * uniform(-1, 1, 2)
    at = torch.linspace(-1, 1, side) * reach
    y, x = torch.meshgrid(at + centre[1], at + centre[0], indexing="ij")
    grid = torch.stack([x, y], -1)[None]
    image = F.grid_sample((chosen.float() / 255).square()[None], grid, align_corners=False)[0]
    if torch.rand((), generator=generator) < 0.2:  # a plain wall
        image = gaussian_blurred(image, side / 6)
    elif torch.rand((), generator=generator) < 0.5:
        image = gaussian_blurred(image, float(uniform(0, 8)))
    exposure = torch.exp(uniform(-3.0, 1.0)) / 6 / image.mean().clamp_min(1e-4)
    return image * exposure * torch.exp(uniform(-0.2, 0.2, 3, 1, 1))


def occluder(side: int, generator: torch.Generator, nearest: float) -> Tensor:
    """Draw the coverage [S, S] of a shape in front of a person, at least `nearest` sides off the middle."""
    uniform = Uniform(generator)
    angle, distance = uniform(0, 2 * math.pi), uniform(nearest, 0.6)
    return shape(0.5 + distance * torch.stack([angle.cos(), angle.sin()]), side, generator)


def shape(centre: Tensor, side: int, generator: torch.Generator) -> Tensor:
    """Draw the coverage [S, S] of an ellipse, a bar or a box around a position [2], in sides."""
    uniform = Uniform(generator)
    long, wide = torch.exp(uniform(-3.2, -0.9)), torch.exp(uniform(-3.5, -1.4))
    tilt = uniform(0, math.pi)
    x, y = (texel_centres_uv(side) - centre).unbind(-1)
    along, across = turned(x, y, tilt)
    a, b = along / long, across / wide
    is_ellipse = torch.rand((), generator=generator) < 0.5
    distance = a.square() + b.square() if is_ellipse else torch.maximum(a.abs(), b.abs()) ** 2
    return ((1 - distance) * side * float(torch.minimum(long, wide)) / 2 + 0.5).clamp(0, 1)
