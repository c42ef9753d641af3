"""A photo's texture as the baselines are fitted to it, and what of a face no prior foresees."""

import torch.nn.functional as F
from torch import Tensor

from facerf_cli.baselines.albedo import SIDE
from facerf_cli.face.regions import region_mask
from facerf_cli.pipeline import FaceTexture

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
