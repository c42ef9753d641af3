"""What every form of the Reflectance Network does with the fields that it is given."""

import torch
import torch.nn.functional as F
from torch import Tensor

MEAN_RADIANCE = 0.25  # of the visible face after exposure is taken out
_LIT = 0.02  # keeps the root's slope finite in the dark

# Of log(red / green) and log(blue / green) of training's sources, each face's mean: 192 draws of a bank.
_CAST_MEAN, _CAST_COVARIANCE = (0.318, -0.214), ((0.094, -0.038), (-0.038, 0.081))
_ORDINARY_CAST = 2.0  # standard deviations, within which a cast is left to the network


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


def colour_cast(texture: Tensor, visible: Tensor) -> Tensor:
    """What to divide linear textures [B, 3, T, T] by, where light has coloured them beyond training's photos.

    [B, 3, 1, 1], positive; the mean radiance stays. Exactly 1 for ordinary photos and grey ones. A face
    further from training's mean colour than `_ORDINARY_CAST` is brought inside, by the inverse of its
    distance: the stranger the colour, the surer it is the light's. visible [B, 1, T, T] in 0..1.
    """
    mean = ((texture * visible).sum((2, 3)) / visible.sum((2, 3)).clamp_min(1e-6)).clamp_min(1e-6).double()
    chroma = (mean[:, [0, 2]] / mean[:, 1:2]).log() - mean.new_tensor(_CAST_MEAN)
    spread = torch.linalg.cholesky(mean.new_tensor(_CAST_COVARIANCE))
    distance = torch.linalg.solve_triangular(spread, chroma.T, upper=False).norm(dim=0)
    inside = (_ORDINARY_CAST / distance.clamp_min(1e-6)) ** 2
    excess = chroma * (1 - inside).clamp_min(0)[:, None]
    cast = torch.stack([excess[:, 0], torch.zeros_like(excess[:, 0]), excess[:, 1]], 1).exp()
    cast = cast * (mean / cast).mean(1, keepdim=True) / mean.mean(1, keepdim=True)
    return cast.to(texture)[..., None, None]


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
