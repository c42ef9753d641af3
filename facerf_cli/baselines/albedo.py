"""A prior on skin for the baselines: a linear Gaussian model of its albedo and gloss in the chart.

The analysis-by-synthesis methods that the paper compares with lean on a morphable model of albedo (Blanz and
Vetter, *A Morphable Model for the Synthesis of 3D Faces*, 1999; with specular albedo: Smith et al., *A
Morphable Face Albedo Model*, 2020). Here it is learnt from this project's procedural skins, by principal
components of logarithms, so that albedo stays positive and light's colour and strength only add to it.
`learn_priors.py` makes the asset: drawn once, it is the same on every machine.
"""

from dataclasses import dataclass
from functools import cache
from pathlib import Path

import torch.nn.functional as F
from torch import Tensor

from facerf_cli.files.checkpoints import load_checkpoint

SIDE = 64  # texels: what is finer is a face's own
ASSET = Path(__file__).parents[1] / "assets" / "baseline_priors.safetensors"


@dataclass(frozen=True, eq=False)
class LogGaussian:
    """A field's logarithm: mean [C, t, t] plus standard normal coordinates times modes [Q, C, t, t]."""

    mean: Tensor
    modes: Tensor

    def at(self, coordinates: Tensor, side: int) -> Tensor:
        """The logarithm [C, T, T] at coordinates [Q], brought to `side` texels."""
        field = self.mean + (coordinates.to(self.modes) @ self.modes.flatten(1)).view_as(self.mean)
        return F.interpolate(field[None], (side, side), mode="bilinear", align_corners=False)[0]


@dataclass(frozen=True, eq=False)
class SkinPrior:
    """Diffuse albedo [3, t, t], linear Rec.709, and reflectance at normal incidence [1, t, t]."""

    diffuse: LogGaussian
    gloss: LogGaussian


@cache
def skin_prior() -> SkinPrior:
    """The shipped prior."""
    tensors, _ = load_checkpoint(ASSET)
    return SkinPrior(
        LogGaussian(tensors["diffuse.mean"], tensors["diffuse.modes"]),
        LogGaussian(tensors["gloss.mean"], tensors["gloss.modes"]),
    )
