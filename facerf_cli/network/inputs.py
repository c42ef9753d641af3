"""Preparation of textures and images for networks: exposure, colour cast, roots, resizing and head pose."""

import math
from dataclasses import dataclass
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor

MEAN_RADIANCE = 0.25  # of the visible face after division by its exposure
_ROOT_OFFSET = 0.02  # keeps the slope of the root finite at black
_ORDINARY_CAST = 2.0  # standard deviations; smaller colour casts are left to the network
_GREY = 1e-4  # difference of a grey image's channels relative to its mean, caused by resampling
_LEAST_DEVIATION = 0.02  # of a log ratio of colours, because grey data have none


@dataclass(frozen=True)
class SourceColours:
    """Mean and covariance of log(red / green) and log(blue / green) of the sources of a network's training.

    The colour of a source is the visible face's mean colour.
    """

    mean: tuple[float, float]
    covariance: tuple[tuple[float, float], tuple[float, float]]

    @staticmethod
    def of(colours: Tensor) -> "SourceColours":
        """Measure the mean colours [N, 3] of sources, scene-linear and positive, N > 1."""
        chroma = _chroma(colours.double())
        covariance = torch.cov(chroma.T) + _LEAST_DEVIATION**2 * torch.eye(2, dtype=chroma.dtype)
        (a, b), (_, c) = covariance.tolist()
        red, blue = chroma.mean(0).tolist()
        return SourceColours((red, blue), ((a, b), (b, c)))

    @staticmethod
    def from_metadata(metadata: Any) -> "SourceColours":
        """Read numbers of a checkpoint; raises KeyError, TypeError or ValueError if they are invalid."""
        red, blue = (float(value) for value in metadata["mean"])
        (a, b), (c, d) = ((float(x), float(y)) for x, y in metadata["covariance"])
        if not (a > 0 and d > 0 and b == c and a * d > b * b and all(map(math.isfinite, (red, blue, a, d)))):
            raise ValueError(f"not colours of sources: {metadata}")
        return SourceColours((red, blue), ((a, b), (c, d)))


def exposure_of(texture: Tensor, visible: Tensor) -> Tensor:
    """Return the positive divisor [B, 1, 1, 1] that gives textures a visible mean of `MEAN_RADIANCE`.

    texture [B, 3, T, T] linear; visible [B, 1, T, T] in 0..1.
    """
    radiance = (texture.mean(1, keepdim=True) * visible).sum((2, 3), keepdim=True)
    exposure = radiance / visible.sum((2, 3), keepdim=True).clamp_min(1e-6) / MEAN_RADIANCE
    return exposure.clamp_min(1e-6)


def colour_cast(texture: Tensor, visible: Tensor, trained: SourceColours) -> Tensor:
    """Return the light's colour cast [B, 3, 1, 1], positive, beyond the range of the training data.

    texture [B, 3, T, T] linear; visible [B, 1, T, T] in 0..1. Dividing a texture by the cast keeps its mean
    radiance. It is exactly 1 for ordinary photos. A colour beyond `_ORDINARY_CAST` from the training data's
    mean moves within that distance; an unusual colour is probably the light's, so the farther away it is, the
    closer to the mean it moves.
    """
    mean = mean_colours(texture, visible)
    red, blue = (part - middle for part, middle in zip(_chroma(mean).unbind(1), trained.mean, strict=True))
    (a, b), (_, c) = trained.covariance
    # Mahalanobis distance from the Cholesky factor of the covariance
    distance = torch.hypot(red / a**0.5, (blue - red * (b / a)) / (c - b * b / a) ** 0.5)
    chroma = torch.stack([red, blue], 1)
    inside = (_ORDINARY_CAST / distance.clamp_min(1e-6)) ** 2
    excess = chroma * (1 - inside).clamp_min(0)[:, None]
    cast = torch.stack([excess[:, 0], torch.zeros_like(excess[:, 0]), excess[:, 1]], 1).exp()
    cast = cast * (mean / cast).mean(1, keepdim=True) / mean.mean(1, keepdim=True)
    return cast.to(texture)[..., None, None]


def without_cast(texture: Tensor, visible: Tensor, trained: SourceColours | None) -> Tensor:
    """Divide textures by their `colour_cast`, like in training; if `trained` is None, do nothing."""
    return texture if trained is None else texture / colour_cast(texture.detach(), visible, trained)


def is_grey(image: Tensor) -> bool:
    """Return whether an image [3, ...] is grey; then the person is also predicted in grey."""
    return bool((image - image[:1]).abs().max() <= _GREY * image.mean())


def mean_colours(texture: Tensor, visible: Tensor) -> Tensor:
    """Return positive mean colours [B, 3], float64, of the visible texels; visible [B, 1, T, T] in 0..1."""
    area = visible.sum((2, 3)).clamp_min(1e-6)
    return ((texture * visible).sum((2, 3)) / area).clamp_min(1e-6).double()


def _chroma(colours: Tensor) -> Tensor:
    return (colours[:, ::2] / colours[:, 1:2]).log()


def to_root(radiance: Tensor) -> Tensor:
    """Compress radiance for a network or a loss: approximately its square root, with a finite slope at 0."""
    return (radiance + _ROOT_OFFSET**2).sqrt() - _ROOT_OFFSET


def from_root(root: Tensor) -> Tensor:
    """Invert `to_root`; negative roots become 0."""
    return root.clamp_min(0) * (root + 2 * _ROOT_OFFSET)


def resize(x: Tensor, side: int) -> Tensor:
    """Resample [B, C, H, W] to a side: by averages for a smaller one, bilinearly for a larger one."""
    if x.shape[-1] == side:
        return x
    if x.shape[-1] > side:
        blocks = x.shape[-1] // side
        if x.shape[-2:] == (side * blocks, side * blocks):  # the same, in half the time
            return F.avg_pool2d(x, blocks)
        return F.interpolate(x, (side, side), mode="area")
    return F.interpolate(x, (side, side), mode="bilinear", align_corners=False)


def head_rotation(mean_normals: Tensor, normals: Tensor) -> Tensor:
    """Estimate head_to_camera [B, 3, 3], the rotation between the mean face's normals and a face's.

    mean_normals [3, S, S] in the head frame, normals [B, 3, T, T] in camera space. Solves the orthogonal
    Procrustes problem.
    """
    small = resize(normals, mean_normals.shape[-1])
    if small.device.type == "mps":  # Apple's GPUs have no doubles
        small = small.cpu()
    moment = torch.einsum("bcij,dij->bcd", small.double(), mean_normals.to(small.device).double())
    u, _, vt = torch.linalg.svd(moment)
    signs = moment.new_ones(len(moment), 3)
    signs[:, 2] = torch.det(u @ vt)
    return (u @ torch.diag_embed(signs) @ vt).to(normals)
