"""A prior on skin for the baselines: a linear Gaussian model of its albedo and gloss in the chart.

The analysis-by-synthesis methods that the paper compares with lean on a morphable model of albedo (Blanz and
Vetter, *A Morphable Model for the Synthesis of 3D Faces*, 1999; with specular albedo: Smith et al., *A
Morphable Face Albedo Model*, 2020). Here it is learnt from this project's procedural skins, by principal
components of logarithms, so that albedo stays positive and light's colour and strength only add to it.
`learn_priors.py` makes the asset: drawn once, it is the same on every machine.

The names of the reflectance models, without what it takes to run them.

A photo's texture as the baselines are fitted to it, and what of a face no prior foresees.

What the field and the baselines have in common: relighting a face, and explaining its photo.

Every model here is linear in its light, and a light is always given as a rig's weights (`RigLight`), so that
what one model reads off a photo can be handed to another.
"""

from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Protocol

import torch
import torch.nn.functional as F
from torch import Tensor

from facerf_cli.face.topology import region_mask
from facerf_cli.light.sphere import RigLight
from facerf_cli.network.checkpoint import load_checkpoint
from facerf_cli.pipeline import FaceTexture

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


_SEEN = 0.5  # of a coarse texel, for it to count
_FLOOR = 0.15  # of the mean shading: in darker shadow less is made of what the photo shows
DETAIL = 0.5  # the share of what the prior lacks of the photo that is taken for the face's
_MOST_DETAIL = 1.5  # of a logarithm


def coarse(face: FaceTexture) -> tuple[Tensor, Tensor]:
    """Radiance [3, t, t] of a photo at the priors' side, and its trust [t, t]; the eyes have none."""
    share = F.interpolate(face.visible[None, None], (SIDE, SIDE), mode="area")[0, 0]
    seen = F.interpolate((face.texture * face.visible)[None], (SIDE, SIDE), mode="area")[0]
    trust = share * (share > _SEEN) * (1 - region_mask("eyes", SIDE))
    return seen / share.clamp_min(1e-6), trust


def shrunk(field: Tensor) -> Tensor:
    """A field [C, T, T] at the priors' side."""
    return F.interpolate(field[None], (SIDE, SIDE), mode="area")[0]


def with_detail(albedo: Tensor, face: FaceTexture, shading: Tensor, shining: Tensor, share: float) -> Tensor:
    """An albedo's logarithm [3, T, T] with a share of what it lacks of the photo.

    `shading` [3, T, T] is the radiance of a white diffuse face in the photo's light, `shining` what the gloss
    adds. The share is least where the photo is dark or the face not seen: it is the most probable residual
    of a Gaussian one, under noise that is relative to the shading.
    """
    if share == 0:
        return albedo
    floor = _FLOOR * (shading * face.visible).sum((1, 2)) / face.visible.sum()
    floor = floor.clamp_min(1e-9)[:, None, None]
    lit = shading.clamp_min(0) + floor
    lacking = (face.texture - shining + floor * albedo.exp()).clamp_min(1e-9).log() - lit.log() - albedo
    finer = albedo + share * face.visible * lacking.clamp(-_MOST_DETAIL, _MOST_DETAIL)
    return finer.clamp(max=0)  # nothing reflects more than it gets


class Reflectance(Protocol):
    """The reflectance of one face, read off one photo."""

    def relit(self, directions: Tensor, weights: Tensor, turn: Tensor | None = None) -> Tensor:
        """Textures [M, 3, T, T], linear, under M sums, weights [M, L, 3], of camera-space lights [L, 3].

        `turn` [3, 3] rotates the head from its pose in the photo (`pipeline.turn_to`); lights stay with the
        camera.
        """


@dataclass(frozen=True, eq=False)
class Explained:
    """A photo taken apart: relit by its own light, the reflectance gives the photo's texture back."""

    reflectance: Reflectance
    light: RigLight


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
