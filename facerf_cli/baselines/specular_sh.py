"""Baseline `specular-sh`: a face with diffuse and specular albedo under spherical-harmonic light.

It uses the assumption of Smith et al. (*A Morphable Face Albedo Model*, CVPR 2020) on this project's fitted
mesh and priors, without their code and their albedo model. The face casts no shadows. The diffuse part uses
light of order 2 (Ramamoorthi and Hanrahan, *An Efficient Representation for Irradiance Environment Maps*,
2001). The gloss is a Blinn-Phong lobe about the reflected view direction, filtered in spherical harmonics
(the same authors' *Frequency Space Environment Map Rendering*, 2002).
"""

import math
from dataclasses import dataclass

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from facerf_cli.baselines.base import Explained
from facerf_cli.baselines.synthesis import (
    SIDE,
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
from facerf_cli.light.sh import coefficients_to_rig, cosine_lobe, rig_coefficients, sh_basis
from facerf_cli.light.sphere import RigLight
from facerf_cli.raster.texture import bake_attributes, normal_map
from facerf_cli.relighting.models import Models

DIFFUSE_ORDER, GLOSS_ORDER = 2, 6
EXPONENT = 12.0  # of the Blinn-Phong lobe; has no degrees above GLOSS_ORDER
_NODES = 256  # of the lobe's quadrature


@dataclass(frozen=True, eq=False)
class FaceSurface:
    """Geometry of the texels in camera space, in the photo's pose."""

    normals: Tensor  # [3, T, T], unit vectors
    positions_m: Tensor  # [3, T, T]
    centre_m: Tensor  # [3], centre of the head's rotation

    def views(self, turn: Tensor | None) -> Tensor:
        """Compute unit directions [3, T, T] to the camera if `turn` rotates the head, in the photo's pose."""
        if turn is None:
            return F.normalize(-self.positions_m, dim=0)
        camera_m = self.centre_m - turn.T @ self.centre_m  # the camera relative to the unrotated head
        return F.normalize(camera_m[:, None, None] - self.positions_m, dim=0)


@dataclass(frozen=True, eq=False)
class SpecularSh:
    """`Reflectance` with diffuse albedo and gloss."""

    surface: FaceSurface
    albedo: Tensor  # [3, T, T]
    gloss: Tensor  # [1, T, T], reflectance at normal incidence

    def relit(self, directions: Tensor, weights: Tensor, turn: Tensor | None = None) -> Tensor:
        """Relight the texture; see `Reflectance`."""
        in_photo = directions if turn is None else directions @ turn  # row vectors: the inverse rotation
        light = rig_coefficients(RigLight(in_photo, weights), GLOSS_ORDER)
        shading, shining = self.parts(light, turn)
        return (self.albedo * shading + self.gloss * shining).clamp_min(0)

    def parts(self, light: Tensor, turn: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """Compute the radiance [M, 3, T, T] of a white diffuse face and of gloss 1, for light [M, K, 3]."""
        transfer = diffuse_transfer(self.surface.normals)
        mirror = mirror_transfer(self.surface.normals, self.surface.views(turn))
        low = transfer.shape[-1]
        shading = torch.einsum("ijk,mkc->mcij", transfer, light[:, :low])
        return shading.clamp_min(0), torch.einsum("ijk,mkc->mcij", mirror, light).clamp_min(0)


def explain_by_specular_sh(models: Models, fit: FaceFit, face: FaceTexture) -> Explained:
    """Estimate the most probable albedo, gloss and light from a fitted photo."""
    vertices = fit.vertices_camera(models.face)
    small = _surface(vertices, fit, SIDE)
    transfer = diffuse_transfer(small.normals)
    mirror = mirror_transfer(small.normals, small.views(None))
    missing = mirror.shape[-1] - transfer.shape[-1]
    transfer = F.pad(transfer, (0, missing)).flatten(0, 1).expand(3, -1, -1)
    scene = scene_of(face, transfer, mirror.flatten(0, 1))
    skin, light = skin_prior(), light_prior(GLOSS_ORDER)
    solution = solve(scene, skin.diffuse, skin.gloss, light)
    side = face.texture.shape[-1]
    albedo, gloss = skin.diffuse.at(solution.albedo, side), skin.gloss.at(solution.gloss, side)
    surface = _surface(vertices, fit, side)
    shading, specular = SpecularSh(surface, albedo, gloss).parts(solution.light[None])
    albedo = with_detail(albedo, face, shading[0], gloss.exp() * specular[0])
    coefficients = solve_light(scene, shrunk(albedo), shrunk(gloss), light)
    return Explained(SpecularSh(surface, albedo.exp(), gloss.exp()), coefficients_to_rig(coefficients))


def _surface(vertices: Tensor, fit: FaceFit, side: int) -> FaceSurface:
    positions_m = bake_attributes(vertices, GRID, side)
    return FaceSurface(normal_map(vertices, grid_triangles(), side), positions_m, fit.translation_m)


def diffuse_transfer(normals: Tensor) -> Tensor:
    """Compute the radiance [T, T, 9] of a white Lambertian face with normals [3, T, T] per coefficient."""
    lobes = [cosine_lobe(degree) / math.pi for degree in range(DIFFUSE_ORDER + 1)]
    return sh_basis(normals.permute(1, 2, 0), DIFFUSE_ORDER) * _by_degree(tuple(lobes))


def mirror_transfer(normals: Tensor, views: Tensor) -> Tensor:
    """Compute the radiance [T, T, K] of gloss 1 for normals and views [3, T, T] per coefficient."""
    cosine = (normals * views).sum(0).clamp(0, 1)
    mirrored = 2 * cosine * normals - views
    mirrored = F.normalize(mirrored, dim=0).permute(1, 2, 0)
    lobe = _by_degree(_blinn_phong(EXPONENT, GLOSS_ORDER))
    return sh_basis(mirrored, GLOSS_ORDER) * lobe


def _by_degree(factors: tuple[float, ...]) -> Tensor:
    """Expand one factor per degree to one per coefficient [K]."""
    return torch.cat([torch.full((2 * degree + 1,), factor) for degree, factor in enumerate(factors)])


def _blinn_phong(exponent: float, order: int) -> tuple[float, ...]:
    """Compute the factors at degrees 0 to `order` of a lobe cos^exponent(angle / 2) with integral 1.

    In their plane, the angle from half vector to normal is half the angle from light to reflected view.
    """
    cosine, weight = np.polynomial.legendre.leggauss(_NODES)
    lobe = weight * ((1 + cosine) / 2) ** (exponent / 2)
    lobe /= lobe.sum()
    unit = np.eye(order + 1)
    return tuple(
        float(lobe @ np.polynomial.legendre.legval(cosine, unit[degree])) for degree in range(order + 1)
    )
