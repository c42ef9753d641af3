"""A reflectance field held to its photo: relit by the photo's own light, the photo comes back.

Where the network is wrong about a face (a white of the eye too bright, a crease too shallow) it is as wrong
under the photo's own light as under one like it, and there the error is known: the photo over what the field
makes of it, a quotient image (Riklin-Raviv and Shashua, *The quotient image*, 2001) of the network's own.
"""

from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor

_FLOOR = 0.2  # of the photo's mean radiance: keeps quotients of shadows near 1
_RANGE = (0.3, 3.0)
_SHARPNESS = 8.0  # of how fast a light is left alone as it shades the face less like the photo's


@dataclass(frozen=True)
class Quotient:
    """Photo over explained photo [3, t, t]; the explained photo's luminance where it is seen [t, t]."""

    ratio: Tensor
    explained: Tensor

    @staticmethod
    def of(photo: Tensor, explained: Tensor, visible: Tensor) -> "Quotient":
        """Of textures [3, t, t], scene-linear; visible [t, t] in 0..1."""
        floor = _FLOOR * (photo.mean(0) * visible).sum() / visible.sum().clamp_min(1e-6)
        ratio = ((photo + floor) / (explained + floor).clamp_min(1e-12)).clamp(*_RANGE)
        return Quotient(1 + visible * (ratio - 1), explained.mean(0) * visible)

    def corrected(self, olats: Tensor) -> Tensor:
        """OLAT textures [l, 3, T, T] times the quotient, each as far as its light is like the photo's.

        Likeness is the cosine between the two pictures, so it is the shading that counts, not where a lamp
        is: a photo's dome of light lends nothing to a lamp from the side.
        """
        small = F.interpolate(olats, self.explained.shape, mode="area").mean(1)
        lengths = (small * (self.explained > 0)).flatten(1).norm(dim=1) * self.explained.norm()
        likeness = (small * self.explained).sum((1, 2)) / lengths.clamp_min(1e-12)
        power = likeness.clamp(0, 1)[:, None, None, None] ** _SHARPNESS
        side = olats.shape[-2:]
        ratio = F.interpolate(self.ratio[None].log(), side, mode="bilinear", align_corners=False)
        return olats * torch.exp(power * ratio)
