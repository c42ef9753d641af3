"""A diffuse face that shadows itself, in the light of spherical harmonics: precomputed radiance transfer.

The assumption of Schneider et al. (*Efficient Global Illumination for Morphable Models*, ICCV 2017), one of
the three that the paper compares with, on this project's fitted mesh and priors; their code and models are
not used, and where they learn the transfer of a morphable model, here each mesh's own is baked
(`baked_transfer.py`), with one bounce off a face of its mean albedo.
"""

import math
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor

from facerf_cli.baselines.albedo import SIDE, skin_prior
from facerf_cli.baselines.baked_transfer import TransferSettings, baked_transfer
from facerf_cli.baselines.light_prior import light_prior
from facerf_cli.baselines.photo_texels import DETAIL, coarse, shrunk, with_detail
from facerf_cli.baselines.reflectance import Explained
from facerf_cli.baselines.synthesis import Scene, SolveSettings, light_given, solve
from facerf_cli.face.fit import FaceFit
from facerf_cli.light.rig_light import RigLight
from facerf_cli.light.sh import coefficients_to_rig, rig_coefficients, rotated
from facerf_cli.pipeline import FaceTexture, Models

SETTINGS, BAKE = SolveSettings(), TransferSettings()
_ROUNDS = 2  # of the face's mean albedo, which tints its bounce


@dataclass(frozen=True, eq=False)
class Prt:
    """Albedo [3, T, T], and transfer [3, K, t, t] in the head frame; `rotation` [3, 3] is the photo's."""

    albedo: Tensor
    transfer: Tensor
    rotation: Tensor

    def relit(self, directions: Tensor, weights: Tensor, turn: Tensor | None = None) -> Tensor:
        """See `Reflectance`."""
        head_to_camera = self.rotation if turn is None else turn @ self.rotation
        order = math.isqrt(self.transfer.shape[1]) - 1
        in_head = RigLight(directions @ head_to_camera, weights)  # rows: camera to head
        return self.albedo * self.shading(rig_coefficients(in_head, order))

    def shading(self, light: Tensor) -> Tensor:
        """Radiance [M, 3, T, T] of a white face in a light of coefficients [M, K, 3] in the head frame."""
        coarse_shading = torch.einsum("ckij,mkc->mcij", self.transfer, light).clamp_min(0)
        side = self.albedo.shape[-2:]
        return F.interpolate(coarse_shading, side, mode="bilinear", align_corners=False)


def explain_by_prt(
    models: Models,
    fit: FaceFit,
    face: FaceTexture,
    settings: SolveSettings = SETTINGS,
    bake: TransferSettings = BAKE,
    detail: float = DETAIL,
) -> Explained:
    """The most probable albedo and light of a fitted photo."""
    vertices = models.face.vertices(fit.alpha[None], fit.beta[None])[0]
    direct, bounce = baked_transfer(vertices, bake)
    side = face.texture.shape[-1]
    tint = skin_prior().diffuse.mean.exp().mean((1, 2))
    light = light_prior(bake.order)
    for _ in range(_ROUNDS):
        transfer = direct + tint[:, None, None, None] * bounce  # [3, K, t, t]
        scene = _scene(transfer, fit, face)
        found = solve(scene, skin_prior().diffuse, skin_prior().gloss, light, settings)
        albedo = skin_prior().diffuse.at(found.albedo, side)
        tint = albedo.exp().mean((1, 2))
    shading = Prt(albedo, transfer, fit.rotation).shading(rotated(found.light, fit.rotation.T)[None])[0]
    albedo = with_detail(albedo, face, shading, torch.zeros_like(shading), detail)
    coefficients = light_given(scene, shrunk(albedo), skin_prior().gloss.mean, light)
    return Explained(Prt(albedo.exp(), transfer, fit.rotation), coefficients_to_rig(coefficients))


def _scene(transfer: Tensor, fit: FaceFit, face: FaceTexture) -> Scene:
    """The photo, and a transfer in the head frame as one in camera space, where the light's prior is."""
    camera_to_head = rotated(torch.eye(transfer.shape[1]), fit.rotation.T)  # [K, K] of coefficients
    small = F.interpolate(transfer, (SIDE, SIDE), mode="area").flatten(2)
    radiance, trust = coarse(face)
    in_camera = torch.einsum("ckn,kj->cnj", small, camera_to_head)
    return Scene(radiance.flatten(1), trust.flatten(), in_camera, None)
