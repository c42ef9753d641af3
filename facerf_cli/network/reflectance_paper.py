"""Reflectance Network of the paper ('Network Architecture'): form `paper`.

A U-Net of 8 down and 8 up convolutions, 3 x 3, with skips, over the source texture T_s and its normals N_s at
512 x 512; the light direction enters at its bottleneck of 2 x 2. Five convolutions of stride 1 follow; they
map its features and the target's normals N_t to the texture T_t. The down path runs once per face, the other
layers once per light. A smaller working side has the same layers; a side of one texel is not halved.

The paper does not specify the following. Channels are 64 to 512, which is usual for such networks. A down
convolution has stride 2; an up convolution follows nearest-neighbour upsampling. Group normalisation follows
each of the U-Net's convolutions except the first, and a leaky rectifier follows each of them; the five
convolutions after the U-Net have rectifiers and no normalisation. A linear layer maps the light's three
numbers to the bottleneck's number of channels. The source is divided by its exposure, and the output is
multiplied by it. The network reads and predicts square roots, which separate shadows like display encodings.
"""

from dataclasses import dataclass
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from facerf_cli.network.base import Count, Side, Widths
from facerf_cli.network.inputs import exposure_of, resize, to_root
from facerf_cli.network.reflectance import ReflectanceNetwork

_SLOPE = 0.2  # of the leaky rectifiers
_GROUPS = 4  # of the group normalisations
_LIGHT_CONVOLUTIONS = 5  # over the U-Net's features and the target's normals
_FIRST_ROOT = 0.3  # approximate square root of the radiance that an untrained network predicts everywhere


@dataclass(frozen=True)
class PaperReflectanceSettings:
    """Working side, channels after each halving of it, and channels of the U-Net's output.

    If `normals` is False, N_s and N_t are left out (paper, 'Ablative Study').
    """

    side: Side = 512
    widths: Widths = (64, 128, 256, 512, 512, 512, 512, 512)
    features: Count = 32
    normals: bool = True


@dataclass(frozen=True)
class PaperEncoded:
    """B encoded faces."""

    features: list[Tensor]  # of the down path, from fine to coarse
    exposure: Tensor  # [B, 1, 1, 1] divisor of the source
    texture_side: int


class PaperReflectanceNetwork(ReflectanceNetwork):
    """Predict OLAT textures, scene-linear and non-negative, from T_s, N_s, N_t and light directions."""

    form = "paper"
    kind_of_settings = PaperReflectanceSettings

    def __init__(self, settings: PaperReflectanceSettings = PaperReflectanceSettings()) -> None:
        super().__init__(settings)
        widths, features = settings.widths, settings.features
        _halved_sides(settings.side, len(widths))  # raises for a side that it cannot halve
        maps = 3 if settings.normals else 0
        before = (3 + maps, *widths[:-1])
        self.down = nn.ModuleList(
            _DownConvolution(a, b, first=i == 0) for i, (a, b) in enumerate(zip(before, widths, strict=True))
        )
        self.light = nn.Linear(3, widths[-1])
        # From fine to coarse, like the down path; the coarsest takes the light's code instead of a skip.
        after = (features, *widths[:-1])
        self.up = nn.ModuleList(_UpConvolution(a, a, b) for a, b in zip(widths, after, strict=True))
        channels = (features + maps, *[features] * (_LIGHT_CONVOLUTIONS - 1))
        self.light_convolutions = nn.ModuleList(
            nn.Conv2d(c, features if i + 1 < _LIGHT_CONVOLUTIONS else 3, 3, padding=1)
            for i, c in enumerate(channels)
        )
        # predict about `_FIRST_ROOT` everywhere
        for module in self.modules():
            if isinstance(module, nn.Conv2d):
                nn.init.kaiming_normal_(module.weight, a=_SLOPE)
        last: Any = self.light_convolutions[-1]
        nn.init.normal_(last.weight, std=1e-2)
        nn.init.constant_(last.bias, float(torch.tensor(_FIRST_ROOT, device="cpu").expm1().log()))

    def encode(self, texture: Tensor, normals_source: Tensor, visible: Tensor) -> PaperEncoded:
        """Encode linear textures and camera-space normals [B, 3, T, T]; visible [B, 1, T, T] in 0..1."""
        exposure = exposure_of(texture, visible)
        root = (texture / exposure).clamp_min(0).add(1e-6).sqrt()  # the offset keeps a finite slope at black
        maps = [root, normals_source] if self.settings.normals else [root]
        x = torch.cat([resize(y, self.settings.side) for y in maps], 1)
        features = []
        for down in self.down:
            x = down(x)
            features.append(x)
        return PaperEncoded(features, exposure, texture.shape[-1])

    def decode(self, encoded: PaperEncoded, normals_target: Tensor, lights: Tensor) -> Tensor:
        """Decode OLAT textures [B, L, 3, T, T] for camera-space lights [B, L, 3], normals [B, 3, T, T]."""
        faces, count, _ = lights.shape
        *skips, bottleneck = encoded.features
        x = bottleneck.repeat_interleave(count, 0)
        code = F.leaky_relu(self.light(lights.flatten(0, 1)), _SLOPE)[..., None, None].expand(
            -1, -1, *bottleneck.shape[-2:]
        )
        sides = [self.settings.side, *_halved_sides(self.settings.side, len(self.up) - 1)]
        for up, skip, side in zip(reversed(self.up), (code, *reversed(skips)), reversed(sides), strict=True):
            x = up(x, skip, side)
        if self.settings.normals:
            normals = resize(normals_target, self.settings.side).to(x.dtype)
            x = torch.cat([x, normals.repeat_interleave(count, 0)], 1)
        *inner, last = self.light_convolutions
        for convolution in inner:
            x = F.leaky_relu(convolution(x), _SLOPE)
        texture = F.softplus(last(x).float()) ** 2 * encoded.exposure.repeat_interleave(count, 0)
        return resize(texture, encoded.texture_side).view(faces, count, 3, *[encoded.texture_side] * 2)

    def decode_root(self, encoded: PaperEncoded, normals_target: Tensor, lights: Tensor) -> Tensor:
        """Decode `to_root` of the textures over the source's exposure [B, L, 3, T, T]."""
        linear = self.decode(encoded, normals_target, lights)
        return to_root(linear.float() / encoded.exposure[:, None])


class _DownConvolution(nn.Module):
    """Halve the side by a convolution of stride 2."""

    def __init__(self, channels_in: int, channels_out: int, first: bool) -> None:
        super().__init__()
        self.convolution = nn.Conv2d(channels_in, channels_out, 3, stride=2, padding=1)
        self.norm = nn.Identity() if first else nn.GroupNorm(_GROUPS, channels_out)

    def forward(self, x: Tensor) -> Tensor:
        return F.leaky_relu(self.norm(self.convolution(x)), _SLOPE)


class _UpConvolution(nn.Module):
    """Upsample coarser features [B L, ...] and a skip [B or B L, ...] to a side, and convolve both."""

    def __init__(self, channels_in: int, skip_channels: int, channels_out: int) -> None:
        super().__init__()
        self.channels_in = channels_in
        self.convolution = nn.Conv2d(channels_in + skip_channels, channels_out, 3, padding=1)
        self.norm = nn.GroupNorm(_GROUPS, channels_out)

    def forward(self, x: Tensor, skip: Tensor, side: int) -> Tensor:
        # A convolution of both, stacked, in two parts: the part of the skip is the same for all lights.
        weight, bias = self.convolution.weight, self.convolution.bias
        own = F.conv2d(_upsampled(x, side), weight[:, : self.channels_in], padding=1)
        shared = F.conv2d(_upsampled(skip, side), weight[:, self.channels_in :], bias, padding=1)
        both = own + shared.repeat_interleave(len(own) // len(shared), 0)
        return F.leaky_relu(self.norm(both), _SLOPE)


def _upsampled(x: Tensor, side: int) -> Tensor:
    return x if x.shape[-1] == side else F.interpolate(x, (side, side), mode="nearest")


def _halved_sides(side: int, times: int) -> list[int]:
    """Return the sides after each halving down to 1; raises ValueError for an odd side above 1."""
    sides = [side]
    for _ in range(times):
        if sides[-1] > 1 and sides[-1] % 2:
            raise ValueError(f"a side of {side} cannot be halved {times} times")
        sides.append(max(1, sides[-1] // 2))
    return sides[1:]
