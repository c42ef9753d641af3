"""Parsing Network: from a crop around a person to classes, matte and landmarks.

A small U-Net. Landmarks are the means of heatmaps (Sun et al., *Integral human pose regression*, 2018), each
with an expected error (Wood et al., *3D face reconstruction with dense landmarks*, 2022). It is trained only
on synthetic portraits (Wood et al., *Fake it till you make it*, 2021).
"""

import itertools
from dataclasses import dataclass
from typing import Any, NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from facerf_cli.network.base import Blocks, Classes, Landmarks, SavedNetwork, Side, WidthsOfFour

_ALPHA_STEPS = 2  # pixels of the classes per pixel of the features, in each direction


@dataclass(frozen=True)
class ParsingSettings:
    """Channels at 1/2, 1/4, ... of the crop's side; side in pixels; numbers of classes and landmarks."""

    widths: WidthsOfFour = (20, 40, 88, 152, 184)
    blocks: Blocks = (0, 1, 2, 3, 2)
    side: Side = 256
    classes: Classes = 14
    landmarks: Landmarks = 92


class Parsing(NamedTuple):
    """Result of the network for B crops of side S."""

    logits: Tensor  # [B, C, S, S] of the classes; class 0 is the background
    landmarks: Tensor  # [B, N, 2] right and down, in sides of the crop
    log_error: Tensor  # [B, N] logarithm of each landmark's expected error, in sides of the crop
    presence: Tensor  # [B] logit of a head's presence

    @property
    def classes(self) -> Tensor:
        """Probabilities [B, C, S, S] of the classes; the matte is 1 less the background's."""
        return self.logits.float().softmax(1)


class Residual(nn.Module):
    """Two convolutions whose result is added to their input."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.norm = nn.GroupNorm(4, channels)
        self.inner = nn.Conv2d(channels, channels, 3, padding=1)
        self.outer = nn.Conv2d(channels, channels, 3, padding=1)

    def forward(self, x: Tensor) -> Tensor:
        """Add the result."""
        result: Tensor = x + self.outer(F.silu(self.inner(F.silu(self.norm(x)))))
        return result


class Halving(nn.Module):
    """Halve the side, then apply residual blocks."""

    def __init__(self, channels_in: int, channels_out: int, blocks: int) -> None:
        super().__init__()
        self.enter = nn.Conv2d(channels_in, channels_out, 3, stride=2, padding=1)
        self.blocks = nn.Sequential(*(Residual(channels_out) for _ in range(blocks)))

    def forward(self, x: Tensor) -> Tensor:
        """Halve and refine features [B, C, H, W]."""
        result: Tensor = self.blocks(F.silu(self.enter(x)))
        return result


class UNet(SavedNetwork):
    """Encoder that halves an image repeatedly, and decoder with skips up to half its side."""

    def __init__(self, settings: Any, channels: int) -> None:
        """Make an untrained network for images of some channels; `settings` has widths, blocks and a side."""
        super().__init__(settings)
        widths, blocks, self.side = settings.widths, settings.blocks, settings.side
        if len(widths) != len(blocks) or self.side % 2 ** len(widths):
            raise ValueError(f"no such network has the settings {settings}")
        self.stem = Halving(channels, widths[0], blocks[0])
        self.encode = nn.ModuleList(
            Halving(a, b, count) for a, b, count in zip(widths, widths[1:], blocks[1:], strict=False)
        )
        pairs = list(itertools.pairwise(widths))
        self.narrow = nn.ModuleList(nn.Conv2d(b, a, 1) for a, b in pairs)
        self.decode = nn.ModuleList(Residual(a) for a, _ in pairs)

    def halved(self, images: Tensor) -> list[Tensor]:
        """Return features [B, C, H, W] of images [B, C, S, S], from side S / 2 to the coarsest."""
        features = [self.stem(images)]
        for halving in self.encode:
            features.append(halving(features[-1]))
        return features

    def doubled(self, halved: list[Tensor]) -> list[Tensor]:
        """Return decoded features from the coarsest to side S / 2, without the coarsest."""
        *skips, x = halved
        features = []
        for narrow, decode, skip in reversed(list(zip(self.narrow, self.decode, skips, strict=True))):
            x = decode(skip + F.interpolate(narrow(x), scale_factor=2.0, mode="nearest"))
            features.append(x)
        return features


class ParsingNetwork(UNet):
    """Parse crops [B, 3, S, S] in sRGB, with any brightness and contrast."""

    kind_of_settings = ParsingSettings

    def __init__(self, settings: ParsingSettings = ParsingSettings()) -> None:
        super().__init__(settings, 3)
        widths = settings.widths
        self.classify = nn.Conv2d(widths[0], settings.classes * _ALPHA_STEPS**2, 1)
        self.heat = nn.Conv2d(widths[1], settings.landmarks, 1)
        self.judge = nn.Sequential(
            nn.Linear(widths[-1], widths[-1]), nn.SiLU(), nn.Linear(widths[-1], settings.landmarks + 1)
        )

    def forward(self, crops: Tensor) -> Parsing:
        """Parse crops; they may have any side that is a multiple of 32."""
        centred = crops - crops.mean((1, 2, 3), keepdim=True)
        halved = self.halved(centred / (centred.square().mean((1, 2, 3), keepdim=True).sqrt() + 0.02))
        judged = self.judge(halved[-1].mean((2, 3))).float()
        *_, at_quarter, at_half = self.doubled(halved)
        logits = F.pixel_shuffle(self.classify(at_half), _ALPHA_STEPS)
        landmarks = _means(self.heat(at_quarter).float())
        return Parsing(logits, landmarks, judged[:, 1:], judged[:, 0])


def _means(heat: Tensor) -> Tensor:
    """Return mean positions [B, N, 2], right and down in sides, of heatmaps with logits [B, N, H, W]."""
    height, width = heat.shape[-2:]
    share = heat.flatten(2).softmax(-1).view_as(heat)
    x = (torch.arange(width, device=heat.device) + 0.5) / width
    y = (torch.arange(height, device=heat.device) + 0.5) / height
    return torch.stack([share.sum(2) @ x, share.sum(3) @ y], -1)
