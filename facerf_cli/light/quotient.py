"""The photo quotient: it corrects a reflectance field so that the photo's own light gives the photo back.

Errors of the network in a face (the white of an eye too bright, a crease too shallow) are about the same
under the photo's light and under similar lights. Under the photo's light they are known: the photo divided by
its reconstruction from the field is a quotient image (Riklin-Raviv and Shashua, *The quotient image*, 2001).
"""

from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor

_FLOOR = 0.2  # as a share of the photo's mean radiance: keeps quotients in shadows near 1
_RANGE = (0.3, 3.0)  # of the quotients
_SHARPNESS = 8.0  # exponent of the likeness: the higher, the more alike a light must shade the face


@dataclass(frozen=True)
class Quotient:
    """Photo over its reconstruction [3, t, t], and the visible reconstruction, grey [t, t].

    `albedo` [3, t, t], if not None, are factors of the field's albedo, which the reconstruction has.
    """

    ratio: Tensor
    explained: Tensor
    albedo: Tensor | None = None

    @staticmethod
    def of(photo: Tensor, explained: Tensor, visible: Tensor, albedo: Tensor | None = None) -> "Quotient":
        """Divide a photo by its reconstruction, scene-linear textures [3, t, t]; visible [t, t] in 0..1."""
        explained = explained if albedo is None else explained * albedo
        floor = _FLOOR * (photo.mean(0) * visible).sum() / visible.sum().clamp_min(1e-6)
        ratio = ((photo + floor) / (explained + floor).clamp_min(1e-12)).clamp(*_RANGE)
        return Quotient(1 + visible * (ratio - 1), explained.mean(0) * visible, albedo)

    def corrected(self, olats: Tensor) -> Tensor:
        """Multiply OLAT textures [l, 3, T, T] by the quotient, to a power that is each light's likeness.

        The factors of albedo are the same for all.

        Likeness is the cosine between the OLAT and the reconstruction. It compares the shading of the face,
        not light directions: a photo under a dome of light hardly corrects a light from the side.
        """
        side = olats.shape[-2:]
        if self.albedo is not None:
            olats = olats * F.interpolate(self.albedo[None], side, mode="bilinear", align_corners=False)
        small = F.interpolate(olats, self.explained.shape, mode="area").mean(1)
        lengths = (small * (self.explained > 0)).flatten(1).norm(dim=1) * self.explained.norm()
        likeness = (small * self.explained).sum((1, 2)) / lengths.clamp_min(1e-12)
        power = likeness.clamp(0, 1)[:, None, None, None] ** _SHARPNESS
        ratio = F.interpolate(self.ratio[None].log(), side, mode="bilinear", align_corners=False)
        return olats * torch.exp(power * ratio)
