"""Baseline `diffuse-sh`: a diffuse face under light of order 2, after Tewari et al. (MoFA, ICCV 2017).

A network (`network/diffuse_sh.py`) regresses albedo and light; then least squares refine the light. The face
is the product of its albedo and shading, without highlights and cast shadows.
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
from facerf_cli.network.diffuse_sh import COEFFICIENTS, ORDER, shading
from facerf_cli.network.inputs import resize
from facerf_cli.relighting.models import Models

_VISIBLE = 0.9  # least visibility of a texel that constrains the light
_HOLD = 1e-4  # weight of the network's light, as a fraction of the evidence on a coefficient
_OUTLIER = 3.0  # error in medians above which a texel loses weight
_ROUNDS = 8  # of reweighting


@dataclass(frozen=True, eq=False)
class Diffuse:
    """Diffuse `Reflectance`."""

    albedo: Tensor  # [3, T, T] at the photo's exposure
    normals: Tensor  # [3, T, T] in the photo's pose

    def relit(self, directions: Tensor, weights: Tensor, turn: Tensor | None = None) -> Tensor:
        """Relight with order 2 of the light and clamp negative radiance to 0; see `Reflectance`."""
        normals = self.normals if turn is None else torch.einsum("dc,cij->dij", turn, self.normals)
        coefficients = rig_coefficients(RigLight(directions, weights), ORDER)
        return self.albedo * shading(normals[None], coefficients[None])[0]


@torch.no_grad()
def explain_by_diffuse_sh(models: Models, fit: FaceFit, face: FaceTexture) -> Explained:
    """Estimate albedo and light from a texture; the light has signed weights of the paper's 150 lights."""
    network, side = models.networks.diffuse_sh, face.texture.shape[-1]
    device = next(network.parameters()).device
    estimate = network(*(x[None].to(device) for x in (face.texture, face.normals, face.visible[None])))
    reflectance = Diffuse(resize(estimate.albedo * estimate.exposure, side)[0].cpu(), face.normals)
    coefficients = refitted(reflectance, face, estimate.coefficients[0].cpu())
    return Explained(reflectance, coefficients_to_rig(coefficients))


def refitted(reflectance: Diffuse, face: FaceTexture, coefficients: Tensor) -> Tensor:
    """Solve for the light [9, 3] that best explains a texture with its albedo, near `coefficients` [9, 3].

    Iteratively reweighted least squares per channel; clipped, shadowed and covered texels lose weight.
    """
    visible = face.visible > _VISIBLE
    white = irradiance(face.normals[:, visible].T.double(), torch.eye(COEFFICIENTS).double()) / math.pi
    channels = []
    for albedo, texture, start in zip(reflectance.albedo, face.texture, coefficients.T, strict=True):
        lit, target = albedo[visible, None] * white, texture[visible].double()  # [N, 9], [N]
        hold = _HOLD * float(lit.square().sum()) / COEFFICIENTS * torch.eye(COEFFICIENTS).double()
        trust = torch.ones_like(target)
        for _ in range(_ROUNDS):
            weighted = lit * trust[:, None]
            light = torch.linalg.solve(weighted.T @ lit + hold, weighted.T @ target + hold @ start.double())
            error = (lit @ light - target).abs().clamp_min(1e-12)
            trust = (_OUTLIER * error.median() / error).clamp_max(1).square()
        channels.append(light.float())
    return torch.stack(channels, -1)
