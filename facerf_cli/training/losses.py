"""Loss terms: the default form's own, and the paper's four ('Loss Functions'), each without its weight.

The paper does not state the units of its terms. Here they are chosen so that the terms have comparable size
at its weights:
- a squared norm is the mean over points or coefficients, an L1 norm the mean over the mask's pixels and
  channels, so that a weight means the same at every size of crop and model;
- landmarks are in units of half the crop's side: image coordinates run from -1 to 1;
- radiance is scene-linear, exposed by `dataset/crops.py`; feature networks see it as sRGB
  (`network/features.py`);
- S_f and a V_f that facerf trained see each colour channel separately, divided by the target's mean of it
  (`channels_apart`): their filters happen to prefer some colours, and would tint uncertain areas; ImageNet's
  V_f sees colours;
- textures are compared where the target's camera sees the face; the target's texture gets no gradient.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import torch
from torch import Tensor

from facerf_cli.errors import InputError
from facerf_cli.face.topology import LAYOUT_VERSION
from facerf_cli.network.checkpoint import load_networks
from facerf_cli.network.features import FeatureNetwork, feature_distance
from facerf_cli.network.inputs import from_root, to_root
from facerf_cli.training.settings import PaperWeights as PaperWeights

_SLOPE_WEIGHT = 0.6  # of differences between neighbouring texels
_RADIANCE_WEIGHT = 16.0  # of squared errors of radiance, which Si-MSE measures, against L1 on roots
_WHITE = 1.0  # radiance that a camera clips at the exposure of samples
_PAPER = PaperWeights()
_DIM, _LEAST_SHARE = 1e-3, 0.1  # radiance below which a colour is noise; of a channel in a mean colour of 1
_BRIGHTEST_ROOT = 1.25  # above it a photograph clips


def root_loss(root: Tensor, target: Tensor, weight: Tensor) -> Tensor:
    """Add L1 on roots (`to_root`), L1 on differences of neighbouring roots, and squared errors of radiance.

    root [B, L, 3, T, T] is the prediction's root (may be negative), target [B, L, 3, T, T] linear,
    weight [B, 1, T, T] is positive where the target pose sees the face. Returns the mean of the faces' means.
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
    """Return mean squared errors [B, L] after the best single scale (Si-MSE; Zhou et al., ICCV 2019).

    prediction, target [B, L, 3, T, T] linear; weight [B, 1, T, T].
    """
    mask = weight[:, None].expand_as(target)
    dims = (-3, -2, -1)
    scale = (prediction * target * mask).sum(dims) / (prediction**2 * mask).sum(dims).clamp_min(1e-12)
    squared = (scale[..., None, None, None] * prediction - target) ** 2
    return (squared * mask).sum(dims) / mask.sum(dims).clamp_min(1e-6)


def clipped_si_mse(prediction: Tensor, target: Tensor, weight: Tensor) -> Tensor:
    """Return `si_mse` of radiance clipped at white; otherwise a few highlights outweigh all faces."""
    return si_mse(prediction.clamp(max=_WHITE), target.clamp(max=_WHITE), weight)


def landmark_loss(found_px: Tensor, detected_px: Tensor, side_px: int) -> Tensor:
    """Return L_l [B]: mean squared distance of the mesh's and the detector's landmarks [B, N, 2].

    Lengths are in units of half the crop's side.
    """
    difference = (found_px - detected_px) * (2 / side_px)
    return difference.square().sum(-1).mean(1)


def slid_contour(candidates_px: Tensor, detected_px: Tensor) -> Tensor:
    """Select the candidates [B, C, 2] closest to the detected points [B, N, 2]: [B, N, 2].

    Contour landmarks slide on the mesh; the choice of their vertices has no gradient.
    """
    with torch.no_grad():
        distances = torch.cdist(detected_px, candidates_px, compute_mode="donot_use_mm_for_euclid_dist")
    return candidates_px.gather(1, distances.argmin(-1)[..., None].expand(-1, -1, 2))


def regularisation(alpha: Tensor, beta: Tensor, weights: PaperWeights = _PAPER) -> Tensor:
    """Return L_r [B]: weighted means of squared identity [B, Ki] and expression coefficients [B, Ke]."""
    return weights.alpha * alpha.square().mean(1) + weights.beta * beta.square().mean(1)


def photometric_loss(prediction: Tensor, target: Tensor, mask: Tensor) -> Tensor:
    """Return L_p [B]: mean L1 difference of images [B, 3, H, W] in the mask [B, 1, H, W], or 0."""
    difference = ((prediction - target).abs() * mask).mean(1, keepdim=True)
    return difference.sum((1, 2, 3)) / mask.sum((1, 2, 3)).clamp_min(1.0)


def colour_shares(target: Tensor) -> Tensor:
    """Return the mean colour [B, 3, 1, 1] of images [B, 3, H, W], over its mean of the channels."""
    mean = target.mean((2, 3), keepdim=True) + _DIM
    return (mean / mean.mean(1, keepdim=True)).clamp_min(_LEAST_SHARE)


def channels_apart(images: Tensor, shares: Tensor) -> Tensor:
    """Make grey images [3 B, 3, H, W] of the channels of images [B, 3, H, W], over the `colour_shares`.

    The target's shares give all channels the same brightness, so that no feature can prefer one.
    """
    return (images / shares).flatten(0, 1)[:, None].expand(-1, 3, -1, -1)


@dataclass(frozen=True)
class Features:
    """V_f or S_f, its layers' mean squares [layers] on training images; `apart`: it sees single channels."""

    network: FeatureNetwork
    powers: Tensor
    apart: bool = False


@dataclass(frozen=True)
class MaskedPair:
    """Prediction and target [B, 3, H, W], linear, compared in the mask [B, 1, H, W].

    L_I is the `distance` of V_f of the image plus the one of the texture, L_L the one of S_f of the texture.
    """

    prediction: Tensor
    target: Tensor
    mask: Tensor

    def distance(self, features: Features) -> Tensor:
        """Return the distance [B] of the features of both, masked, over the features' powers."""
        prediction, target = self.prediction * self.mask, self.target * self.mask
        shares = colour_shares(target)
        if features.apart:
            prediction, target = (channels_apart(image, shares) for image in (prediction, target))
        distance = feature_distance(features.network, prediction, target, features.powers)
        if not features.apart:
            return distance
        return (distance.view(-1, 3) * shares.flatten(1)).mean(1)  # so that channels are pulled alike


def load_features(
    path: Path, name: Literal["light_features", "appearance_features"], side: int | None = None
) -> Any:
    """Load S_f ('light_features') or V_f ('appearance_features'), frozen, from a checkpoint of its stage.

    Raises InputError if it was not trained on images of `side`: features of another scale mislead a loss.
    """
    network: Any = load_networks(path, LAYOUT_VERSION)[0].get(name)
    stage = name.replace("_", "-")
    if network is None:
        raise InputError(f"{path}: has no network {name}; use a checkpoint of `facerf train --stage {stage}`")
    trained = network.settings.side
    if side is not None and trained != side:
        raise InputError(
            f"{path}: its network {name} was trained on images of {trained} px, here they have {side}; train "
            f"it with --stage {stage} --texture-size {side}, or pass --texture-size {trained} here"
        )
    network.eval().requires_grad_(False)
    return network
