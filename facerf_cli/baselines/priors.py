"""Priors of skin and light for the baselines: Gaussian models, learnt from procedural skins and envmaps.

The methods with which the paper compares use a morphable model of albedo (Blanz and Vetter, *A Morphable
Model for the Synthesis of 3D Faces*, 1999; with specular albedo: Smith et al., *A Morphable Face Albedo
Model*, 2020). Here it is replaced by the principal components of logarithms of albedo and gloss in UV space:
albedo stays positive, and the colour and strength of a light only add to it. `tools/baseline_priors.py`
learns the priors; they ship as an asset, so that every machine has the same.
"""

from dataclasses import dataclass
from functools import cache
from pathlib import Path

import torch
import torch.nn.functional as F
from torch import Tensor

from facerf_cli.network.checkpoint import load_checkpoint

SIDE = 64  # texels of the priors of skin; finer detail is individual
ASSET = Path(__file__).parents[1] / "assets" / "baseline_priors.safetensors"
_LEAST_SPREAD = 1e-3  # of a mode of light, relative to the first: below it a mode is rounding error


@dataclass(frozen=True, eq=False)
class LogGaussian:
    """Logarithm of a texture: mean [C, t, t] plus standard normal coordinates times modes [Q, C, t, t]."""

    mean: Tensor
    modes: Tensor

    def at(self, coordinates: Tensor, side: int) -> Tensor:
        """The logarithm [C, T, T] at coordinates [Q], resampled to `side` texels."""
        field = self.mean + (coordinates.to(self.modes) @ self.modes.flatten(1)).view_as(self.mean)
        return F.interpolate(field[None], (side, side), mode="bilinear", align_corners=False)[0]


@dataclass(frozen=True, eq=False)
class SkinPrior:
    """Diffuse albedo [3, t, t], linear Rec.709, and gloss: reflectance at normal incidence [1, t, t]."""

    diffuse: LogGaussian
    gloss: LogGaussian


@dataclass(frozen=True, eq=False)
class LightPrior:
    """Coefficients of a light (`light/sh.py`): mean [K, 3] plus standard normals times modes [R, K, 3]."""

    mean: Tensor
    modes: Tensor


@cache
def skin_prior() -> SkinPrior:
    """Load the shipped prior of skin."""
    tensors, _ = load_checkpoint(ASSET)
    return SkinPrior(
        LogGaussian(tensors["diffuse.mean"], tensors["diffuse.modes"]),
        LogGaussian(tensors["gloss.mean"], tensors["gloss.modes"]),
    )


@cache
def light_prior(order: int) -> LightPrior:
    """Load the shipped prior of light, truncated to an order up to that of the asset; R <= 3 K."""
    tensors, _ = load_checkpoint(ASSET)
    count = (order + 1) ** 2
    mean, modes = tensors["light.mean"], tensors["light.modes"]
    if count > len(mean):
        raise ValueError(f"the prior has {len(mean)} coefficients, not {count}")
    _, spread, rotated = torch.linalg.svd(modes[:, :count].flatten(1), full_matrices=False)
    kept = spread > _LEAST_SPREAD * spread[0]
    return LightPrior(mean[:count], (spread[kept, None] * rotated[kept]).view(-1, count, 3))
