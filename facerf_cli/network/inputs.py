"""Steps between a texture and the layers of a network: exposure, colour cast, roots, resizing, head pose."""

import torch
import torch.nn.functional as F
from torch import Tensor

MEAN_RADIANCE = 0.25  # of the visible face once its exposure is divided out
_ROOT_OFFSET = 0.02  # keeps the slope of the root finite at black

# Mean and covariance of log(red / green) and log(blue / green) of the mean colour of a training source,
# measured on 192 draws of a bank.
_CAST_MEAN, _CAST_COVARIANCE = (0.318, -0.214), ((0.094, -0.038), (-0.038, 0.081))
_ORDINARY_CAST = 2.0  # standard deviations within which a colour cast is left to the network


def exposure_of(texture: Tensor, visible: Tensor) -> Tensor:
    """Exposure of linear textures [B, 3, T, T]: divided by it, their visible mean is `MEAN_RADIANCE`.

    visible [B, 1, T, T] in 0..1; the result is [B, 1, 1, 1] and positive.
    """
    radiance = (texture.mean(1, keepdim=True) * visible).sum((2, 3), keepdim=True)
    exposure = radiance / visible.sum((2, 3), keepdim=True).clamp_min(1e-6) / MEAN_RADIANCE
    return exposure.clamp_min(1e-6)


def colour_cast(texture: Tensor, visible: Tensor) -> Tensor:
    """Colour cast of the light on linear textures [B, 3, T, T], as far as it exceeds that of training photos.

    visible [B, 1, T, T] in 0..1; the result is [B, 3, 1, 1] and positive. Divide textures by it: their mean
    radiance does not change. It is exactly 1 for ordinary and for grey photos. A colour further from the mean
    colour of training than `_ORDINARY_CAST` is moved within that distance, and the further it is the closer
    to the mean: the less usual the colour, the more certainly it is the light's.
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


def to_root(radiance: Tensor) -> Tensor:
    """Compress radiance for a network or a loss: nearly its square root, 0 at 0, with a finite slope."""
    return (radiance + _ROOT_OFFSET**2).sqrt() - _ROOT_OFFSET


def from_root(root: Tensor) -> Tensor:
    """Invert `to_root`; 0 for negative roots."""
    return root.clamp_min(0) * (root + 2 * _ROOT_OFFSET)


def resize(x: Tensor, side: int) -> Tensor:
    """Resample [B, C, H, W] to a side: averaged if that is smaller, bilinear if it is larger."""
    if x.shape[-1] == side:
        return x
    if x.shape[-1] > side:
        return F.interpolate(x, (side, side), mode="area")
    return F.interpolate(x, (side, side), mode="bilinear", align_corners=False)


def head_rotation(mean_normals: Tensor, normals: Tensor) -> Tensor:
    """Estimate head_to_camera [B, 3, 3], which best rotates the mean face's normals to those of a face.

    mean_normals [3, S, S] in the head frame, normals [B, 3, T, T] in camera space. The solution is that of
    the orthogonal Procrustes problem.
    """
    small = resize(normals, mean_normals.shape[-1]).cpu().double()  # Apple's GPUs have no doubles
    moment = torch.einsum("bcij,dij->bcd", small, mean_normals.cpu().double())
    u, _, vt = torch.linalg.svd(moment)
    signs = torch.ones(len(moment), 3, dtype=moment.dtype)
    signs[:, 2] = torch.det(u @ vt)
    return (u @ torch.diag_embed(signs) @ vt).to(normals)
