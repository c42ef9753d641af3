"""What every form of the Reflectance Network does with the fields that it is given."""

import torch
import torch.nn.functional as F
from torch import Tensor

MEAN_RADIANCE = 0.25  # of the visible face after exposure is taken out
_LIT = 0.02  # keeps the root's slope finite in the dark


def to_root(radiance: Tensor) -> Tensor:
    """What the default form predicts and its loss compares: nearly the square root, 0 at 0."""
    return (radiance + _LIT**2).sqrt() - _LIT


def from_root(root: Tensor) -> Tensor:
    """The radiance of a root; none below 0."""
    return root.clamp_min(0) * (root + 2 * _LIT)


def exposure_of(texture: Tensor, visible: Tensor) -> Tensor:
    """What to divide linear textures [B, 3, T, T] by, so that their visible mean is `MEAN_RADIANCE`.

    visible [B, 1, T, T] in 0..1; the result is [B, 1, 1, 1] and positive.
    """
    radiance = (texture.mean(1, keepdim=True) * visible).sum((2, 3), keepdim=True)
    exposure = radiance / visible.sum((2, 3), keepdim=True).clamp_min(1e-6) / MEAN_RADIANCE
    return exposure.clamp_min(1e-6)


def resize(x: Tensor, side: int) -> Tensor:
    """Resample [B, C, H, W] to a side: averaged when smaller, bilinear when larger."""
    if x.shape[-1] == side:
        return x
    if x.shape[-1] > side:
        return F.interpolate(x, (side, side), mode="area")
    return F.interpolate(x, (side, side), mode="bilinear", align_corners=False)


def head_rotation(mean_normals: Tensor, normals: Tensor) -> Tensor:
    """head_to_camera [B, 3, 3] that best turn the mean face's normals [3, S, S] to normals [B, 3, T, T]."""
    small = resize(normals, mean_normals.shape[-1]).cpu().double()  # Apple's GPUs have no doubles
    moment = torch.einsum("bcij,dij->bcd", small, mean_normals.cpu().double())
    u, _, vt = torch.linalg.svd(moment)
    signs = torch.ones(len(moment), 3, dtype=moment.dtype)
    signs[:, 2] = torch.det(u @ vt)
    return (u @ torch.diag_embed(signs) @ vt).to(normals)
