"""What training minimises. The paper's four terms come with its preset; this is the default form's own."""

from torch import Tensor

_GRADIENT_WEIGHT = 1.0
_LIT = 0.02  # keeps the square root's slope finite in the dark


def root_loss(root: Tensor, target: Tensor, weight: Tensor) -> Tensor:
    """L1 on square roots and on their differences between neighbours, where the target pose sees the face.

    root [B, L, 3, T, T] is the prediction's square root (may be negative), target [B, L, 3, T, T] linear,
    weight [B, 1, T, T].
    """
    wanted = (target.clamp(0, 4) + _LIT**2).sqrt() - _LIT
    mask = weight[:, None]
    error = root - wanted
    value = (error.abs() * mask).sum() / (mask.expand_as(error).sum() + 1e-6)
    slope_x, slope_y = error.diff(dim=-1).abs(), error.diff(dim=-2).abs()
    slopes = (slope_x * mask[..., 1:]).mean() + (slope_y * mask[..., 1:, :]).mean()
    return value + _GRADIENT_WEIGHT * slopes


def si_mse(prediction: Tensor, target: Tensor, weight: Tensor) -> Tensor:
    """Scale-invariant mean squared error [B, L] (Zhou et al., ICCV 2019): after the best single scale.

    prediction, target [B, L, 3, T, T] linear; weight [B, 1, T, T].
    """
    mask = weight[:, None].expand_as(target)
    dims = (-3, -2, -1)
    scale = (prediction * target * mask).sum(dims) / (prediction**2 * mask).sum(dims).clamp_min(1e-12)
    squared = (scale[..., None, None, None] * prediction - target) ** 2
    return (squared * mask).sum(dims) / mask.sum(dims).clamp_min(1e-6)
