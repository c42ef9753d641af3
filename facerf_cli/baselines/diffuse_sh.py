"""Baseline `diffuse-sh`: a diffuse face under light of order 2, after Tewari et al. (MoFA, ICCV 2017).

One network (`network/diffuse_sh.py`) regresses albedo and light, then the light is solved for with that
albedo. A face is the product of its albedo and shading: it has no highlights and no cast shadows.
"""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from facerf_cli.baselines.base import Explained
from facerf_cli.face.fit import FaceFit
from facerf_cli.face.head import FaceTexture
from facerf_cli.light.sh import coefficients_to_rig, irradiance, rig_coefficients
from facerf_cli.light.sphere import RigLight
from facerf_cli.network.diffuse_sh import COEFFICIENTS, ORDER, DiffuseNetwork, shading
from facerf_cli.network.inputs import resize
from facerf_cli.relighting.models import Models

_SEEN = 0.9  # visibility from which on a texel counts in the solution for the light
_HOLD = 1e-4  # weight of the network's light, as a share of the evidence on a coefficient
_OUTLIER = 3.0  # median errors from which on a texel's weight falls
_ROUNDS = 8  # of reweighting


@dataclass(frozen=True, eq=False)
class Diffuse:
    """Albedo [3, T, T] at the exposure and normals [3, T, T] in the pose of a photo; a `Reflectance`."""

    albedo: Tensor
    normals: Tensor

    def relit(self, directions: Tensor, weights: Tensor, turn: Tensor | None = None) -> Tensor:
        """See `Reflectance`; only order 2 of the light is used, and negative radiance becomes 0."""
        normals = self.normals if turn is None else torch.einsum("dc,cij->dij", turn, self.normals)
        coefficients = rig_coefficients(RigLight(directions, weights), ORDER)
        return self.albedo * shading(normals[None], coefficients[None])[0]


def explain_by_diffuse_sh(models: Models, fit: FaceFit, face: FaceTexture) -> Explained:
    """Estimate albedo and light by the models' network, or by the shipped one; `fit` is not used."""
    return explain_texture(models.networks.diffuse_sh, face)


@torch.no_grad()
def explain_texture(
    network: DiffuseNetwork, face: FaceTexture, fine: bool = True, refit: bool = True
) -> Explained:
    """Estimate albedo and light of a texture; the light as signed weights of the paper's 150 lights.

    `fine` applies the network's gain and bias at the side of the texture, else at that of the network.
    `refit` improves the network's light by `refitted`. Both improve the baseline.
    """
    device, side = next(network.parameters()).device, face.texture.shape[-1]
    inputs = [x[None].to(device) for x in (face.texture, face.normals, face.visible[None])]
    if not fine:
        inputs = [resize(x, network.settings.side) for x in inputs]
    estimate = network(*inputs)
    reflectance = Diffuse(resize(estimate.albedo * estimate.exposure, side)[0].cpu(), face.normals)
    coefficients = estimate.coefficients[0].cpu()
    if refit:
        coefficients = refitted(reflectance, face, coefficients)
    return Explained(reflectance, coefficients_to_rig(coefficients))


def refitted(reflectance: Diffuse, face: FaceTexture, coefficients: Tensor) -> Tensor:
    """Solve for the light [9, 3] that best explains a texture by its albedo, near `coefficients` [9, 3].

    Iteratively reweighted least squares, a channel at a time: clipped, shadowed and covered texels lose
    weight.
    """
    seen = face.visible > _SEEN
    white = irradiance(face.normals[:, seen].T.double(), torch.eye(COEFFICIENTS).double()) / math.pi  # [N, 9]
    found = []
    for albedo, texture, start in zip(reflectance.albedo, face.texture, coefficients.T, strict=True):
        lit, target = albedo[seen, None] * white, texture[seen].double()
        hold = _HOLD * float(lit.square().sum()) / COEFFICIENTS * torch.eye(COEFFICIENTS).double()
        trust = torch.ones_like(target)
        for _ in range(_ROUNDS):
            weighted = lit * trust[:, None]
            light = torch.linalg.solve(weighted.T @ lit + hold, weighted.T @ target + hold @ start.double())
            error = (lit @ light - target).abs().clamp_min(1e-12)
            trust = (_OUTLIER * error.median() / error).clamp_max(1).square()
        found.append(light.float())
    return torch.stack(found, -1)
