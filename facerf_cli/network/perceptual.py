"""LPIPS: how different two pictures look, by the features of VGG-16 (version 0.1).

Zhang et al., *The Unreasonable Effectiveness of Deep Features as a Perceptual Metric*, CVPR 2018, the form
'lin' on VGG. The published code takes encoded pictures in -1..1 and scales them by shift -.030 -.088 -.188
and scale .458 .448 .450; in 0..1 that is ImageNet's mean and deviation, so V_f's own first step serves.
"""

from collections.abc import Mapping

import torch
from torch import Tensor, nn

from facerf_cli.network.features import LPIPS_LAYERS, VggFeatures

SMALLEST_PX = 16  # below it the last layers have nothing to see
_EPSILON = 1e-10  # the published code's, beside the length


class Lpips(nn.Module):
    """The distance of pictures; VGG-16's tensors are `trunk.features.N`, the heads `heads.N` [C]."""

    def __init__(self, width: float = 1.0) -> None:
        """`width` scales the channels, for tests; 1 is what is published."""
        super().__init__()
        self.trunk = VggFeatures(width, LPIPS_LAYERS)
        self.heads = nn.ParameterList([torch.ones(count) / count for count in self.trunk.layer_channels()])

    def forward(self, first: Tensor, second: Tensor) -> Tensor:
        """LPIPS [B] of scene-linear pictures [B, 3, H, W], at least 16 px a side; they are encoded."""
        if min(first.shape[-2:]) < SMALLEST_PX or first.shape != second.shape:
            raise ValueError(f"pictures {tuple(first.shape)} and {tuple(second.shape)}")
        total = first.new_zeros(len(first))
        layers = zip(self.trunk.layers(first), self.trunk.layers(second), self.heads, strict=True)
        for a, b, head in layers:
            squared = (_unit(a) - _unit(b)).square()
            total = total + torch.einsum("bchw,c->bhw", squared, head).mean((1, 2))
        return total

    def load_heads(self, tensors: Mapping[str, Tensor]) -> None:
        """Take the heads by the published names, `linN.model.1.weight` [1, C, 1, 1].

        Raises ValueError in words where one is missing or is none.
        """
        found = []
        for place, head in enumerate(self.heads):
            name = f"lin{place}.model.1.weight"
            given = tensors.get(name)
            if not isinstance(given, Tensor):
                raise ValueError(f"it has no {name}")
            if given.shape != (1, len(head), 1, 1) or not given.is_floating_point():
                raise ValueError(f"its {name} is {' x '.join(map(str, given.shape))} of {given.dtype}")
            if not (given.isfinite() & (given >= 0)).all():
                raise ValueError(f"its {name} holds values below 0 or not finite")
            found.append(given.flatten())
        with torch.no_grad():
            for head, values in zip(self.heads, found, strict=True):
                head.copy_(values)


def _unit(features: Tensor) -> Tensor:
    """Features [B, C, H, W] of length 1 at each place; 0 where there are none."""
    return features / (features.square().sum(1, keepdim=True).sqrt() + _EPSILON)
