"""A prior on light for the baselines: a Gaussian of spherical-harmonic coefficients.

Lights are not alike in all directions: there is more of it above than below, and its colours go together.
So the mean and the covariance are those of this project's procedural maps, turned about the vertical, each of
mean radiance 1; a face's light is such a light times a strength that is left free.
"""

from dataclasses import dataclass
from functools import cache

import torch
from torch import Tensor

from facerf_cli.baselines.albedo import ASSET
from facerf_cli.files.checkpoints import load_checkpoint


@dataclass(frozen=True, eq=False)
class LightPrior:
    """Coefficients (`light/sh.py`, camera axes): mean [K, 3] plus standard normals times modes [R, K, 3]."""

    mean: Tensor
    modes: Tensor


@cache
def light_prior(order: int) -> LightPrior:
    """The shipped prior, of what an `order` holds of it (up to that of the asset); R <= 3 K."""
    tensors, _ = load_checkpoint(ASSET)
    count = (order + 1) ** 2
    mean, modes = tensors["light.mean"], tensors["light.modes"]
    if count > len(mean):
        raise ValueError(f"the prior has {len(mean)} coefficients, not {count}")
    _, spread, turned = torch.linalg.svd(modes[:, :count].flatten(1), full_matrices=False)
    kept = spread > 1e-3 * spread[0]
    return LightPrior(mean[:count], (spread[kept, None] * turned[kept]).view(-1, count, 3))
