"""A face of diffuse and specular albedo in the light of spherical harmonics, without shadows of its own.

The assumption of Smith et al. (*A Morphable Face Albedo Model*, CVPR 2020), one of the three that the paper
compares with, on this project's fitted mesh and priors; their code and their model of albedo are not used.
The diffuse part takes light of order 2 (Ramamoorthi and Hanrahan, *An Efficient Representation for
Irradiance Environment Maps*, 2001), the gloss a Blinn-Phong lobe about the mirrored view, filtered in
spherical harmonics (the same authors' *Frequency Space Environment Map Rendering*, 2002).
"""

import math
from dataclasses import dataclass
from functools import cache

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from facerf_cli.baselines.base import (
    DETAIL,
    SIDE,
    Explained,
    coarse,
    light_prior,
    shrunk,
    skin_prior,
    with_detail,
)
from facerf_cli.baselines.synthesis import Scene, SolveSettings, light_given, solve
from facerf_cli.face.fit import FaceFit
from facerf_cli.face.topology import GRID, grid_triangles
from facerf_cli.light.sh import coefficients_to_rig, cosine_lobe, rig_coefficients, sh_basis
from facerf_cli.light.sphere import RigLight
from facerf_cli.pipeline import FaceTexture, Models
from facerf_cli.raster.texture import bake_attributes, normal_map

DIFFUSE_ORDER, GLOSS_ORDER = 2, 6
EXPONENT = 12.0  # of the Blinn-Phong lobe, which then ends at GLOSS_ORDER
SETTINGS = SolveSettings()
_NODES = 256  # at which the lobe is integrated


@dataclass(frozen=True, eq=False)
class Surface:
    """Texels in camera space, of the photo's pose: unit normals and positions [3, T, T] in metres.

    The head turns about `centre_m` [3].
    """

    normals: Tensor
    positions_m: Tensor
    centre_m: Tensor

    def views(self, turn: Tensor | None) -> Tensor:
        """Unit directions [3, T, T] to the camera of the head turned by `turn`, in the photo's pose."""
        if turn is None:
            return F.normalize(-self.positions_m, dim=0)
        camera_m = self.centre_m - turn.T @ self.centre_m  # where the camera is to the unturned head
        return F.normalize(camera_m[:, None, None] - self.positions_m, dim=0)


@dataclass(frozen=True, eq=False)
class SpecularSh:
    """Diffuse albedo [3, T, T] and reflectance at normal incidence [1, T, T] on a surface."""

    surface: Surface
    albedo: Tensor
    gloss: Tensor

    def relit(self, directions: Tensor, weights: Tensor, turn: Tensor | None = None) -> Tensor:
        """See `Reflectance`."""
        in_photo = directions if turn is None else directions @ turn  # rows: the inverse of the turn
        light = rig_coefficients(RigLight(in_photo, weights), GLOSS_ORDER)
        shading, shining = self.parts(light, turn)
        return (self.albedo * shading + self.gloss * shining).clamp_min(0)

    def parts(self, light: Tensor, turn: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """Radiance of a white diffuse face, and of gloss 1 [M, 3, T, T], for coefficients [M, K, 3]."""
        transfer = diffuse_transfer(self.surface.normals)
        mirror = mirror_transfer(self.surface.normals, self.surface.views(turn))
        low = transfer.shape[-1]
        shading = torch.einsum("ijk,mkc->mcij", transfer, light[:, :low])
        return shading.clamp_min(0), torch.einsum("ijk,mkc->mcij", mirror, light).clamp_min(0)


def explain_by_specular_sh(
    models: Models,
    fit: FaceFit,
    face: FaceTexture,
    settings: SolveSettings = SETTINGS,
    detail: float = DETAIL,
) -> Explained:
    """The most probable albedo, gloss and light of a fitted photo."""
    vertices = fit.vertices_camera(models.face)
    small = _surface(vertices, fit, SIDE)
    transfer = diffuse_transfer(small.normals)
    mirror = mirror_transfer(small.normals, small.views(None))
    missing = mirror.shape[-1] - transfer.shape[-1]
    transfer = F.pad(transfer, (0, missing)).flatten(0, 1).expand(3, -1, -1)
    radiance, trust = coarse(face)
    scene = Scene(radiance.flatten(1), trust.flatten(), transfer, mirror.flatten(0, 1))
    skin, light = skin_prior(), light_prior(GLOSS_ORDER)
    found = solve(scene, skin.diffuse, skin.gloss, light, settings)
    side = face.texture.shape[-1]
    albedo, gloss = skin.diffuse.at(found.albedo, side), skin.gloss.at(found.gloss, side)
    surface = _surface(vertices, fit, side)
    shading, shining = SpecularSh(surface, albedo, gloss).parts(found.light[None])
    albedo = with_detail(albedo, face, shading[0], gloss.exp() * shining[0], detail)
    coefficients = light_given(scene, shrunk(albedo), shrunk(gloss), light)
    return Explained(SpecularSh(surface, albedo.exp(), gloss.exp()), coefficients_to_rig(coefficients))


def _surface(vertices: Tensor, fit: FaceFit, side: int) -> Surface:
    positions_m = bake_attributes(vertices, GRID, side)
    return Surface(normal_map(vertices, grid_triangles(), side), positions_m, fit.translation_m)


def diffuse_transfer(normals: Tensor) -> Tensor:
    """Radiance [T, T, 9] of a white Lambertian face of normals [3, T, T], a coefficient of the light."""
    lobes = [cosine_lobe(degree) / math.pi for degree in range(DIFFUSE_ORDER + 1)]
    return sh_basis(normals.permute(1, 2, 0), DIFFUSE_ORDER) * _by_degree(tuple(lobes))


def mirror_transfer(normals: Tensor, views: Tensor) -> Tensor:
    """Radiance [T, T, K] of gloss 1, a coefficient of the light, for normals and views [3, T, T]."""
    cosine = (normals * views).sum(0).clamp(0, 1)
    mirrored = 2 * cosine * normals - views
    mirrored = F.normalize(mirrored, dim=0).permute(1, 2, 0)
    lobe = _by_degree(_blinn_phong(EXPONENT, GLOSS_ORDER))
    return sh_basis(mirrored, GLOSS_ORDER) * lobe


def _by_degree(factors: tuple[float, ...]) -> Tensor:
    """A factor of each degree as one of each coefficient [K]."""
    return torch.cat([torch.full((2 * degree + 1,), factor) for degree, factor in enumerate(factors)])


@cache
def _blinn_phong(exponent: float, order: int) -> tuple[float, ...]:
    """The factors at degrees 0 to `order` of a lobe cos^exponent(angle / 2) whose integral is 1.

    The half vector's angle to the normal is half the light's to the mirrored view, in the plane of both.
    """
    cosine, share = np.polynomial.legendre.leggauss(_NODES)
    lobe = share * ((1 + cosine) / 2) ** (exponent / 2)
    lobe /= lobe.sum()
    unit = np.eye(order + 1)
    return tuple(
        float(lobe @ np.polynomial.legendre.legval(cosine, unit[degree])) for degree in range(order + 1)
    )
