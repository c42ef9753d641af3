"""What training minimises. The paper's four terms come with its preset; this is the default form's own."""

from torch import Tensor

from facerf_cli.network.inputs import from_root, to_root

_SLOPE_WEIGHT = 0.6
_RADIANCE_WEIGHT = 16.0  # of squared errors as Si-MSE has them, against L1 on roots
_WHITE = 1.0  # where a camera clips, at the exposure of samples
_BRIGHTEST_ROOT = 1.25  # beyond it a photograph clips


def root_loss(root: Tensor, target: Tensor, weight: Tensor) -> Tensor:
    """L1 on roots (`to_root`) and on their differences between neighbours, and squares of the radiance's.

    root [B, L, 3, T, T] is the prediction's root (may be negative), target [B, L, 3, T, T] linear,
    weight [B, 1, T, T] is where the target pose sees the face. The mean of the faces' own means.
    """
    wanted = to_root(target.clamp(0, 4))
    mask = weight[:, None]
    dims = (1, 2, 3, 4)
    seen = mask.sum(dims) * root.shape[1] * root.shape[2] + 1e-6
    error = root - wanted
    value = (error.abs() * mask).sum(dims)
    slope_x = (error.diff(dim=-1).abs() * mask[..., 1:]).sum(dims)
    slope_y = (error.diff(dim=-2).abs() * mask[..., 1:, :]).sum(dims)
    radiance, true_radiance = (from_root(x.clamp(0, _BRIGHTEST_ROOT)) for x in (root, wanted))
    squared = ((radiance - true_radiance) ** 2 * mask).sum(dims)
    return ((value + _SLOPE_WEIGHT * (slope_x + slope_y) + _RADIANCE_WEIGHT * squared) / seen).mean()


def si_mse(prediction: Tensor, target: Tensor, weight: Tensor) -> Tensor:
    """Scale-invariant mean squared error [B, L] (Zhou et al., ICCV 2019): after the best single scale.

    prediction, target [B, L, 3, T, T] linear; weight [B, 1, T, T].
    """
    mask = weight[:, None].expand_as(target)
    dims = (-3, -2, -1)
    scale = (prediction * target * mask).sum(dims) / (prediction**2 * mask).sum(dims).clamp_min(1e-12)
    squared = (scale[..., None, None, None] * prediction - target) ** 2
    return (squared * mask).sum(dims) / mask.sum(dims).clamp_min(1e-6)


def clipped_si_mse(prediction: Tensor, target: Tensor, weight: Tensor) -> Tensor:
    """`si_mse` of what a camera would have kept of both: a few glints of the truth outweigh all faces."""
    return si_mse(prediction.clamp(max=_WHITE), target.clamp(max=_WHITE), weight)
