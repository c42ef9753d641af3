"""What training minimises. The paper's four terms come with its preset; this is the default form's own.

The terms of the paper's loss ('Loss Functions'), each a value a sample, before their weights.

What the paper leaves open, and how it stands here, so that the terms are of comparable size at its weights:
- a squared norm is the mean over its points or coefficients, an L1 norm the mean over the mask's pixels and
  channels, so that a weight means the same at every size of crop and model;
- landmarks are in units of half the crop's side, as where the picture goes from -1 to 1;
- radiance is linear and exposed as `dataset/crops.py` says; features look at it as sRGB (`features.py`);
- the texture of the target is compared where the target's camera sees it, and is no target to move.
"""

from dataclasses import dataclass

import torch
from torch import Tensor

from facerf_cli.network.feature_networks import FeatureNetwork, feature_distance
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


@dataclass(frozen=True)
class PaperWeights:
    """lambda_l, lambda_r, lambda_p, lambda_f of the whole, and lambda_alpha, lambda_beta of its priors."""

    landmarks: float = 25.0
    regularisation: float = 1.0
    photometric: float = 5.0
    features: float = 1.0
    alpha: float = 0.4
    beta: float = 0.002


def landmark_loss(found_px: Tensor, detected_px: Tensor, side_px: int) -> Tensor:
    """L_l of one picture of each sample [B]: landmarks of the mesh and the detector's [B, N, 2].

    The mean of their squared distances, lengths in units of half the crop's side.
    """
    difference = (found_px - detected_px) * (2 / side_px)
    return difference.square().sum(-1).mean(1)


@torch.no_grad()
def closest_points(candidates_px: Tensor, detected_px: Tensor) -> Tensor:
    """Index [B, N] of the candidate [B, C, 2] that lies closest to each detected point [B, N, 2].

    Contour landmarks slide on the mesh: its vertices that are these landmarks for now are a constant.
    """
    return torch.cdist(detected_px, candidates_px, compute_mode="donot_use_mm_for_euclid_dist").argmin(-1)


def slid_contour(candidates_px: Tensor, detected_px: Tensor) -> Tensor:
    """The candidates [B, C, 2] closest to the detected points [B, N, 2], as [B, N, 2] with their gradient."""
    ids = closest_points(candidates_px, detected_px)
    return candidates_px.gather(1, ids[..., None].expand(-1, -1, 2))


def regularisation(alpha: Tensor, beta: Tensor, weights: PaperWeights = PaperWeights()) -> Tensor:
    """L_r of one picture of each sample [B]: means of squared identity [B, Ki] and expression [B, Ke]."""
    return weights.alpha * alpha.square().mean(1) + weights.beta * beta.square().mean(1)


def photometric_loss(prediction: Tensor, target: Tensor, mask: Tensor) -> Tensor:
    """L_p [B]: mean difference of pictures [B, 3, H, W] in the mask [B, 1, H, W], 0 if it is empty."""
    difference = ((prediction - target).abs() * mask).mean(1, keepdim=True)
    return difference.sum((1, 2, 3)) / mask.sum((1, 2, 3)).clamp_min(1.0)


@dataclass(frozen=True)
class Seen:
    """A prediction and its truth [B, 3, H, W], linear, and where they are compared, mask [B, 1, H, W]."""

    prediction: Tensor
    target: Tensor
    mask: Tensor

    def distance(self, net: FeatureNetwork) -> Tensor:
        """Of the features of both, masked alike [B]."""
        return feature_distance(net, self.prediction * self.mask, self.target * self.mask)


def appearance_loss(net: FeatureNetwork, image: Seen, texture: Seen) -> Tensor:
    """L_I [B]: V_f of the masked picture and of the texture."""
    return image.distance(net) + texture.distance(net)


def light_loss(net: FeatureNetwork, texture: Seen) -> Tensor:
    """L_L [B]: S_f, which knows where light comes from, of the texture."""
    return texture.distance(net)
