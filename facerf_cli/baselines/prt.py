"""Baseline `prt`: a diffuse face with its own shadows and one bounce, by precomputed radiance transfer.

It uses the assumption of Schneider et al. (*Efficient Global Illumination for Morphable Models*, ICCV 2017)
on this project's fitted mesh and priors, without their code and models. They learn the transfer of a
morphable model; here, the transfer of each mesh is baked.
"""

import math
from dataclasses import dataclass

import numpy as np
import torch
import torch.nn.functional as F
from scipy.ndimage import gaussian_filter
from torch import Tensor

from facerf_cli.baselines.base import Explained
from facerf_cli.baselines.synthesis import (
    SIDE,
    known,
    light_prior,
    scene_of,
    shrunk,
    skin_prior,
    solve,
    solve_light,
    with_detail,
)
from facerf_cli.face.fit import FaceFit
from facerf_cli.face.head import FaceTexture
from facerf_cli.face.topology import GRID, grid_triangles
from facerf_cli.light.sh import coefficients_to_rig, rig_coefficients, rotated, sh_basis
from facerf_cli.light.sphere import RigLight, rig_directions
from facerf_cli.light.transport import BakeSettings, bake_transport
from facerf_cli.raster.texture import bake_attributes, normal_map
from facerf_cli.relighting.models import Models

_ROUNDS = 2  # of estimating the face's mean albedo, which tints the bounce


@dataclass(frozen=True)
class TransferSettings:
    """Resolution of the baked transfer."""

    order: int = 4  # of the harmonics
    side: int = 128  # texels
    lights: int = 200  # number of area lights, each as wide as its cell
    light_samples: int = 4  # rays per texel and light
    bounce_samples: int = 16  # rays per texel
    blur_texels: float = 1.0  # removes the noise of few samples


BAKE = TransferSettings()


@dataclass(frozen=True, eq=False)
class Prt:
    """Diffuse `Reflectance` with baked shadows and bounce."""

    albedo: Tensor  # [3, T, T]
    transfer: Tensor  # [3, K, t, t], head frame
    rotation: Tensor  # [3, 3], head to camera in the photo

    def relit(self, directions: Tensor, weights: Tensor, turn: Tensor | None = None) -> Tensor:
        """Relight the texture; see `Reflectance`."""
        head_to_camera = self.rotation if turn is None else turn @ self.rotation
        order = math.isqrt(self.transfer.shape[1]) - 1
        in_head = RigLight(directions @ head_to_camera, weights)  # rows: camera to head
        return self.albedo * self.shading(rig_coefficients(in_head, order))

    def shading(self, light: Tensor) -> Tensor:
        """Compute the radiance [M, 3, T, T] of a white face for light coefficients [M, K, 3], head frame."""
        coarse_shading = torch.einsum("ckij,mkc->mcij", self.transfer, light).clamp_min(0)
        side = self.albedo.shape[-2:]
        return F.interpolate(coarse_shading, side, mode="bilinear", align_corners=False)


def explain_by_prt(models: Models, fit: FaceFit, face: FaceTexture) -> Explained:
    """Estimate the most probable albedo and light from a fitted photo."""
    vertices = models.face.vertices(fit.alpha[None], fit.beta[None])[0]
    direct, bounce = bake_transfer(vertices, BAKE)
    skin, light, side = skin_prior(), light_prior(BAKE.order), face.texture.shape[-1]
    tint = skin.diffuse.mean.exp().mean((1, 2))
    camera_to_head = rotated(torch.eye(direct.shape[0]), fit.rotation.T)  # [K, K] of coefficients
    for _ in range(_ROUNDS):
        transfer = direct + tint[:, None, None, None] * bounce  # [3, K, t, t], head frame
        small = F.interpolate(transfer, (SIDE, SIDE), mode="area").flatten(2)
        in_camera = torch.einsum("ckn,kj->cnj", small, camera_to_head)
        scene = scene_of(face, in_camera, torch.zeros_like(in_camera[0]))
        solution = solve(scene, skin.diffuse, known(skin.gloss.mean), light)
        albedo = skin.diffuse.at(solution.albedo, side)
        tint = albedo.exp().mean((1, 2))
    shading = Prt(albedo, transfer, fit.rotation).shading(rotated(solution.light, fit.rotation.T)[None])[0]
    albedo = with_detail(albedo, face, shading, torch.zeros_like(shading))
    coefficients = solve_light(scene, shrunk(albedo), skin.gloss.mean, light)
    return Explained(Prt(albedo.exp(), transfer, fit.rotation), coefficients_to_rig(coefficients))


def bake_transfer(vertices_head: Tensor, settings: TransferSettings) -> Tensor:
    """Bake the transfer vectors [2, K, t, t] of a mesh [V, 3] in the head frame.

    Their products with light coefficients are the radiance of a white diffuse face: [0] direct, with its
    shadows, [1] after one bounce from a face of albedo 1 (Sloan, Kautz and Snyder, *Precomputed Radiance
    Transfer*, 2002).
    """
    positions = bake_attributes(vertices_head, GRID, settings.side).permute(1, 2, 0)
    normals = normal_map(vertices_head, grid_triangles(), settings.side).permute(1, 2, 0)
    directions = rig_directions(settings.lights)
    cell_deg = float(np.degrees(2 / np.sqrt(settings.lights)))  # the radius of a cap of a cell's solid angle
    transport = bake_transport(
        positions.numpy(),
        normals.numpy(),
        vertices_head.numpy(),
        grid_triangles().numpy(),
        directions.numpy(),
        BakeSettings(settings.light_samples, cell_deg, settings.bounce_samples),
    )
    cosines = torch.einsum("lc,ijc->lij", directions, normals).clamp_min(0)
    direct = torch.from_numpy(transport.visibility) * cosines
    both = torch.stack([direct, torch.from_numpy(transport.bounce).float()])
    # Cells have the solid angle 4 pi / L; the division by pi is the Lambertian BRDF.
    basis = sh_basis(directions, settings.order) * (4 / settings.lights)
    transfer = torch.einsum("lk,nlij->nkij", basis, both).numpy()
    blur = settings.blur_texels
    return torch.from_numpy(gaussian_filter(transfer, (0, 0, blur, blur), mode="nearest"))
