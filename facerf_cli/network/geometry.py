"""Geometry Network: from the crop of a face to pose, identity and expression.

See paper, 'Network Architecture'. It has two forms. `paper` is the trunk of AlexNet (Krizhevsky et al.,
*ImageNet classification with deep convolutional neural networks*, 2012) with the layer sizes of its one-tower
form (Krizhevsky, *One weird trick for parallelizing convolutional neural networks*, 2014), without dropout,
which a regression does not need. `default` is a small residual trunk on a smaller crop. Rotations leave
the network as two columns that are then orthonormalised (Zhou et al., *On the continuity of rotation
representations in neural networks*, 2019).
"""

from dataclasses import dataclass
from itertools import pairwise
from typing import Annotated, Literal, NamedTuple

import torch
import torch.nn.functional as F
from pydantic import Field
from torch import Tensor, nn

from facerf_cli.network.base import Down, SavedNetwork
from facerf_cli.network.inputs import resize

GeometryForm = Literal["default", "paper"]
_SIDES: dict[str, int] = {"default": 64, "paper": 224}  # of each form's crop
Coefficients = Annotated[int, Field(ge=0, le=500)]
_SHIFT, _DEPTH = 0.05, 0.2  # shift of the head per unit of an output: relative to the depth, in log depth
_ALPHA, _BETA = 0.3, 0.7  # standard deviations of the coefficients per unit, like the fit's priors
_BRIGHTEST = 4.0  # largest deviation of a crop's square root from its mean, in standard deviations


@dataclass(frozen=True)
class GeometryNetworkSettings:
    """Form, coefficients of the built-in face model, and the translation (m) at outputs of zero."""

    form: GeometryForm = "default"
    identity: Coefficients = 40
    expression: Coefficients = 29
    mean_translation_m: tuple[float, float, Annotated[float, Field(gt=-100, lt=0)]] = (0.0, 0.0, -1.1)


class GeometryEstimate(NamedTuple):
    """Pose and shape of B heads, in the space of the crop's camera (`raster.camera.crop_camera`)."""

    rotation: Tensor  # [B, 3, 3] head_to_camera
    translation_m: Tensor  # [B, 3]
    alpha: Tensor  # [B, Ki] identity coefficients of the built-in face model
    beta: Tensor  # [B, Ke] its expression coefficients


class GeometryNetwork(SavedNetwork):
    """Estimate heads from crops [B, 3, S, S], scene-linear at any exposure and side."""

    kind_of_settings = GeometryNetworkSettings  # includes the form
    mean_translation_m: Tensor

    def __init__(self, settings: GeometryNetworkSettings = GeometryNetworkSettings()) -> None:
        super().__init__(settings)
        self.side = _SIDES[settings.form]
        self.trunk, width = _alexnet() if settings.form == "paper" else _small()
        self.regress = nn.Linear(width, 9 + settings.identity + settings.expression)
        nn.init.normal_(self.regress.weight, std=1e-3)
        nn.init.zeros_(self.regress.bias)
        mean = torch.tensor(settings.mean_translation_m)
        self.register_buffer("mean_translation_m", mean, persistent=False)

    def forward(self, crops: Tensor) -> GeometryEstimate:
        """Estimate pose and shape; the crops' exposure does not matter."""
        raw = self.regress(self.trunk(self._normalised(crops))).float()
        columns, shift, alpha, beta = raw.split(
            (6, 3, self.settings.identity, self.settings.expression), dim=1
        )
        return GeometryEstimate(_rotation(columns), self._translation(shift), _ALPHA * alpha, _BETA * beta)

    def _normalised(self, crops: Tensor) -> Tensor:
        """Return square roots of the crops at the network's side, with zero mean and unit deviation."""
        crops = resize(crops, self.side)
        root = (crops.clamp_min(0) / crops.mean((1, 2, 3), keepdim=True).clamp_min(1e-8)).sqrt()
        centred = root - root.mean((1, 2, 3), keepdim=True)
        deviation = (centred * centred).mean((1, 2, 3), keepdim=True).sqrt()
        return (centred / (deviation + 1e-3)).clamp(-_BRIGHTEST, _BRIGHTEST)

    def _translation(self, raw: Tensor) -> Tensor:
        mean = self.mean_translation_m
        depth_m = -mean[2] * torch.exp(_DEPTH * raw[:, 2])
        across = depth_m[:, None] * (_SHIFT * raw[:, :2] - mean[:2] / mean[2])
        return torch.cat([across, -depth_m[:, None]], 1)


def _rotation(columns: Tensor) -> Tensor:
    """Return rotations [B, 3, 3] whose first two columns differ by [B, 6] from the identity's."""
    identity = torch.eye(2, 3, device=columns.device).flatten()
    first, second = (columns + identity).chunk(2, 1)
    x = F.normalize(first, dim=1)
    y = F.normalize(second - (x * second).sum(1, keepdim=True) * x, dim=1)
    return torch.stack([x, y, torch.linalg.cross(x, y)], 2)


def _alexnet() -> tuple[nn.Module, int]:
    """Return AlexNet without its last layer, and its number of outputs."""

    def convolution(channels: int, out: int, side: int, stride: int = 1, padding: int = 1) -> list[nn.Module]:
        return [nn.Conv2d(channels, out, side, stride, padding), nn.ReLU()]

    def full(channels: int, out: int) -> list[nn.Module]:
        return [nn.Linear(channels, out), nn.ReLU()]

    trunk = nn.Sequential(
        *convolution(3, 64, 11, stride=4, padding=2),
        nn.MaxPool2d(3, 2),
        *convolution(64, 192, 5, padding=2),
        nn.MaxPool2d(3, 2),
        *convolution(192, 384, 3),
        *convolution(384, 256, 3),
        *convolution(256, 256, 3),
        nn.MaxPool2d(3, 2),
        nn.AdaptiveAvgPool2d(6),
        nn.Flatten(),
        *full(256 * 6 * 6, 4096),
        *full(4096, 4096),
    )
    return trunk, 4096


def _small() -> tuple[nn.Module, int]:
    """Return a trunk of five halvings, residual except the first, and its number of outputs.

    The last cells are not pooled, because their positions contain the pose.
    """
    widths = (24, 48, 88, 144, 192)
    enter = (nn.Conv2d(3, widths[0], 3, stride=2, padding=1), nn.GroupNorm(8, widths[0]), nn.SiLU())
    stages = [*enter, *(Down(a, b, groups=8) for a, b in pairwise(widths))]
    return nn.Sequential(*stages, nn.Flatten(), nn.Linear(widths[-1] * 2 * 2, 160), nn.SiLU()), 160
