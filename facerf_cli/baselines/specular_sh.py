"""Baseline `specular-sh`: a face of diffuse and specular albedo in the light of spherical harmonics.

The assumption is that of Smith et al. (*A Morphable Face Albedo Model*, CVPR 2020), on this project's fitted
mesh and priors; their code and their model of albedo are not used. No part of the face shadows another. The
diffuse part uses light of order 2 (Ramamoorthi and Hanrahan, *An Efficient Representation for Irradiance
Environment Maps*, 2001). The gloss is a Blinn-Phong lobe about the reflected view direction, filtered in
spherical harmonics (the same authors' *Frequency Space Environment Map Rendering*, 2002).
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
    light_given,
    light_prior,
    scene_of,
    shrunk,
    skin_prior,
    solve,
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
EXPONENT = 12.0  # of the Blinn-Phong lobe, which then has no degrees above GLOSS_ORDER
_NODES = 256  # of the quadrature of the lobe


@dataclass(frozen=True, eq=False)
class FaceSurface:
    """Unit normals and positions [3, T, T] (m) of the texels, in camera space and the pose of the photo.

    `centre_m` [3] is the point about which the head rotates.
    """

    normals: Tensor
    positions_m: Tensor
    centre_m: Tensor

    def views(self, turn: Tensor | None) -> Tensor:
        """Unit directions [3, T, T] toward the camera of the head rotated by `turn`, in the photo's pose."""
        if turn is None:
            return F.normalize(-self.positions_m, dim=0)
        camera_m = self.centre_m - turn.T @ self.centre_m  # the camera relative to the head in its old pose
        return F.normalize(camera_m[:, None, None] - self.positions_m, dim=0)


@dataclass(frozen=True, eq=False)
class SpecularSh:
    """Diffuse albedo [3, T, T] and gloss [1, T, T] of a surface; a `Reflectance`.

    Gloss is the reflectance at normal incidence.
    """

    surface: FaceSurface
    albedo: Tensor
    gloss: Tensor

    def relit(self, directions: Tensor, weights: Tensor, turn: Tensor | None = None) -> Tensor:
        """See `Reflectance`."""
        in_photo = directions if turn is None else directions @ turn  # rows: the inverse of the turn
        light = rig_coefficients(RigLight(in_photo, weights), GLOSS_ORDER)
        shading, shining = self.parts(light, turn)
        return (self.albedo * shading + self.gloss * shining).clamp_min(0)

    def parts(self, light: Tensor, turn: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """Radiance [M, 3, T, T] of a white diffuse face, and of gloss 1, for coefficients [M, K, 3]."""
        transfer = diffuse_transfer(self.surface.normals)
        mirror = mirror_transfer(self.surface.normals, self.surface.views(turn))
        low = transfer.shape[-1]
        shading = torch.einsum("ijk,mkc->mcij", transfer, light[:, :low])
        return shading.clamp_min(0), torch.einsum("ijk,mkc->mcij", mirror, light).clamp_min(0)


def explain_by_specular_sh(models: Models, fit: FaceFit, face: FaceTexture) -> Explained:
    """Estimate the most probable albedo, gloss and light of a fitted photo."""
    vertices = fit.vertices_camera(models.face)
    small = _surface(vertices, fit, SIDE)
    transfer = diffuse_transfer(small.normals)
    mirror = mirror_transfer(small.normals, small.views(None))
    missing = mirror.shape[-1] - transfer.shape[-1]
    transfer = F.pad(transfer, (0, missing)).flatten(0, 1).expand(3, -1, -1)
    scene = scene_of(face, transfer, mirror.flatten(0, 1))
    skin, light = skin_prior(), light_prior(GLOSS_ORDER)
    found = solve(scene, skin.diffuse, skin.gloss, light)
    side = face.texture.shape[-1]
    albedo, gloss = skin.diffuse.at(found.albedo, side), skin.gloss.at(found.gloss, side)
    surface = _surface(vertices, fit, side)
    shading, shining = SpecularSh(surface, albedo, gloss).parts(found.light[None])
    albedo = with_detail(albedo, face, shading[0], gloss.exp() * shining[0])
    coefficients = light_given(scene, shrunk(albedo), shrunk(gloss), light)
    return Explained(SpecularSh(surface, albedo.exp(), gloss.exp()), coefficients_to_rig(coefficients))


def _surface(vertices: Tensor, fit: FaceFit, side: int) -> FaceSurface:
    positions_m = bake_attributes(vertices, GRID, side)
    return FaceSurface(normal_map(vertices, grid_triangles(), side), positions_m, fit.translation_m)


def diffuse_transfer(normals: Tensor) -> Tensor:
    """Radiance [T, T, 9] of a white Lambertian face of normals [3, T, T], per coefficient of the light."""
    lobes = [cosine_lobe(degree) / math.pi for degree in range(DIFFUSE_ORDER + 1)]
    return sh_basis(normals.permute(1, 2, 0), DIFFUSE_ORDER) * _by_degree(tuple(lobes))


def mirror_transfer(normals: Tensor, views: Tensor) -> Tensor:
    """Radiance [T, T, K] of gloss 1 for normals and views [3, T, T], per coefficient of the light."""
    cosine = (normals * views).sum(0).clamp(0, 1)
    mirrored = 2 * cosine * normals - views
    mirrored = F.normalize(mirrored, dim=0).permute(1, 2, 0)
    lobe = _by_degree(_blinn_phong(EXPONENT, GLOSS_ORDER))
    return sh_basis(mirrored, GLOSS_ORDER) * lobe


def _by_degree(factors: tuple[float, ...]) -> Tensor:
    """Repeat a factor for each degree as one for each coefficient [K]."""
    return torch.cat([torch.full((2 * degree + 1,), factor) for degree, factor in enumerate(factors)])


def _blinn_phong(exponent: float, order: int) -> tuple[float, ...]:
    """Factors at degrees 0 to `order` of a lobe cos^exponent(angle / 2) whose integral is 1.

    In the plane of both, the angle of the half vector to the normal is half that of the light to the
    reflected view direction.
    """
    cosine, share = np.polynomial.legendre.leggauss(_NODES)
    lobe = share * ((1 + cosine) / 2) ** (exponent / 2)
    lobe /= lobe.sum()
    unit = np.eye(order + 1)
    return tuple(
        float(lobe @ np.polynomial.legendre.legval(cosine, unit[degree])) for degree in range(order + 1)
    )
