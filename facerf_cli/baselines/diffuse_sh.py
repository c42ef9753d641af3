"""A face that is diffuse, under light of order 2: what the paper's comparison with Tewari et al. assumes.

Albedo and light are regressed by one network (`network/diffuse_sh.py`, after MoFA, ICCV 2017), and the light
is then solved for with that albedo; a face is lit by their product alone, so it has no highlights and casts
no shadows on itself.
"""

import math
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from facerf_cli.baselines.base import Explained
from facerf_cli.errors import InputError
from facerf_cli.face.fit import FaceFit
from facerf_cli.face.topology import LAYOUT_VERSION
from facerf_cli.light.sh import coefficients_to_rig, irradiance, rig_coefficients
from facerf_cli.light.sphere import RigLight
from facerf_cli.network.checkpoint import load_networks
from facerf_cli.network.diffuse_sh import COEFFICIENTS, ORDER, DiffuseNetwork, shading
from facerf_cli.network.reflectance import resize
from facerf_cli.pipeline import FaceTexture, Models

_SEEN = 0.9  # of a texel, for the light's sake
_HOLD = 1e-4  # to the network's light, as a share of the evidence on a coefficient
_OUTLIER, _ROUNDS = 3.0, 8  # texels further off than so many median errors weigh less; of reweighting
CHECKPOINT = Path(__file__).parents[1] / "assets" / "diffuse_sh.safetensors"


@dataclass(frozen=True, eq=False)
class Diffuse:
    """Albedo [3, T, T] at the photo's exposure, and the normals [3, T, T] of the photo's pose."""

    albedo: Tensor
    normals: Tensor

    def relit(self, directions: Tensor, weights: Tensor, turn: Tensor | None = None) -> Tensor:
        """See `Reflectance`; of a light its order 2 alone counts, and what that makes negative is black."""
        normals = self.normals if turn is None else torch.einsum("dc,cij->dij", turn, self.normals)
        coefficients = rig_coefficients(RigLight(directions, weights), ORDER)
        return self.albedo * shading(normals[None], coefficients[None])[0]


def explain_by_diffuse_sh(models: Models, fit: FaceFit, face: FaceTexture) -> Explained:
    """Albedo and light of a face's photo, by the network that is shipped where the models have none.

    `fit` is not needed.
    """
    return explain_texture(models.diffuse or load_diffuse_network(CHECKPOINT).to(models.device), face)


@torch.no_grad()
def explain_texture(
    network: DiffuseNetwork, face: FaceTexture, fine: bool = True, refit: bool = True
) -> Explained:
    """Albedo and light of a texture; the light as signed weights over the paper's 150 lights.

    `fine`: the network's gain and bias are applied at the texture's own side; else at the network's.
    `refit`: its light is where `refitted` starts. Both make the baseline stronger (benchmarks/diffuse_sh.py).
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
    """The light [9, 3] that explains a texture best given its albedo, held a little to `coefficients` [9, 3].

    Least squares, a channel at a time; what is clipped, shadowed or covered weighs less.
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


@cache
def load_diffuse_network(path: Path) -> DiffuseNetwork:
    """The network of a checkpoint of `facerf train --stage diffuse-sh`; read once a process."""
    network: Any = load_networks(path, LAYOUT_VERSION)[0].get("diffuse_sh")
    if not isinstance(network, DiffuseNetwork):
        raise InputError(f"{path}: holds no diffuse network; give one by `facerf train --stage diffuse-sh`")
    return network.eval()
