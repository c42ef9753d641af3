"""Shading of skin and hair: shadowed diffuse light with one bounce, subsurface scattering, specular lobes.

Lights are directional, of rgb 1: a white Lambertian surface that faces one has radiance 1 (irradiance pi).
"""

import math
from dataclasses import dataclass
from typing import Any, NamedTuple, Self

import torch
import torch.nn.functional as F
from torch import Tensor

from facerf_cli.network.batch import Batch

LOBES = ((1.0, 0.75), (0.55, 0.25))  # skin: (roughness factor, weight) of a broad and of a narrow, oily lobe
_NORMAL_VARIANCE = 0.18  # largest addition to alpha squared where normals vary within a facet
_SCATTER_REACH = 6  # texels of the kernel on each side
# Lobes R, TRT and TT of hair: shift to the tip in radians, and factor of the width.
_STRAND_LOBES = ((-0.12, 1.0), (0.17, 2.0), (0.06, 0.7))
_TRANSMITTED, _TRANSMITTED_WIDTH = 0.5, 0.45  # of TT: strength, standard deviation around the strand


@dataclass(frozen=True)
class Material(Batch):
    """Surface as textures [C, H, W] with row v = 0 at the top, or at N points [N, C] ([N] if C is 1).

    albedo [3, H, W] linear Rec.709; specular [1, H, W] reflectance at normal incidence; roughness [1, H, W]
    (GGX alpha is its square); relief [2, H, W] slopes of fine relief along +u and +v.
    """

    albedo: Tensor
    specular: Tensor
    roughness: Tensor
    relief: Tensor

    def part(self, which: Any) -> Self:
        """Select by the first dimension of every field."""
        return self.each(lambda values: values[which])


@dataclass(frozen=True)
class Skin(Material):
    """Material of B faces as textures [B, C, T, T]; scattering_texels [B, 3]: see `scatter`."""

    scattering_texels: Tensor


def diffuse_irradiance(
    visibility: Tensor, bounce: Tensor, cosines: Tensor, albedo: Tensor, weights: Tensor
) -> Tensor:
    """Compute irradiance [3, T, T] on one face under L lights of rgb `weights` [L, 3].

    visibility, bounce and cosines are [L, T, T]. The bounce is tinted by the mean of the albedo [3, T, T].
    """
    tint = albedo.mean((1, 2))[:, None]  # [3, 1]
    direct = weights.T @ (visibility * cosines.clamp_min(0)).flatten(1)
    returned = weights.T @ bounce.flatten(1)
    return (direct + tint * returned).view(3, *visibility.shape[1:])


def scatter(irradiance: Tensor, sigma_texels: Tensor) -> Tensor:
    """Blur irradiance [B, 3, T, T] by one Gaussian per channel, of sigma [B, 3] texels."""
    faces, channels, side, _ = irradiance.shape
    reach = _SCATTER_REACH
    offset = torch.arange(-reach, reach + 1, device=irradiance.device)
    kernel = torch.exp(-0.5 * (offset / sigma_texels.reshape(-1, 1)) ** 2)
    kernel = kernel / kernel.sum(-1, keepdim=True)
    flat = F.pad(irradiance.reshape(1, -1, side, side), (reach,) * 4, mode="replicate")
    groups = faces * channels
    flat = F.conv2d(flat, kernel.view(groups, 1, 1, -1), groups=groups)
    flat = F.conv2d(flat, kernel.view(groups, 1, -1, 1), groups=groups)
    return flat.view(faces, channels, side, side)


def highlights(normals: Tensor, views: Tensor, lights: Tensor, skin: Skin) -> Tensor:
    """Compute specular radiance [B, L, T, T] under lights toward unit directions [B, L, 3].

    Two GGX lobes with Smith shadowing and Schlick's Fresnel term (Walter et al., *Microfacet models*, 2007).
    normals and views are unit fields [B, 3, T, T] in the frame of the lights.
    """
    n_dot_v = (normals * views).sum(1, keepdim=True).clamp_min(0.05)
    half = unit_along(lights[..., None, None] + views[:, None], 2)  # [B, L, 3, T, T]
    n_dot_h = (half * normals[:, None]).sum(2).clamp(0, 1)
    v_dot_h = (half * views[:, None]).sum(2).clamp(0, 1)
    n_dot_l = torch.einsum("blc,bcij->blij", lights, normals).clamp_min(0)
    cosines = Cosines(n_dot_l, n_dot_v, n_dot_h, v_dot_h)
    return two_lobes(cosines, skin.specular, skin.roughness)


class Cosines(NamedTuple):
    """Cosines between normal n, light l, view v and half vector h, in 0..1; their shapes broadcast."""

    n_dot_l: Tensor
    n_dot_v: Tensor
    n_dot_h: Tensor
    v_dot_h: Tensor


def two_lobes(cosines: Cosines, specular: Tensor, roughness: Tensor) -> Tensor:
    """Compute the radiance of the two specular lobes; the shapes of all arguments broadcast."""
    n_dot_l, n_dot_v, n_dot_h, v_dot_h = cosines
    away = 1 - v_dot_h
    fresnel = specular + (1 - specular) * (away * away).square() * away
    total = torch.zeros_like(n_dot_l)
    for factor, weight in LOBES:
        alpha_squared = (roughness * factor) ** 4
        spread = (n_dot_h.square() * (alpha_squared - 1) + 1).square()  # GGX: D = alpha^2 / (pi spread)
        masking = _smith(n_dot_l, alpha_squared) * _smith(n_dot_v, alpha_squared)
        total += (weight * alpha_squared) / (spread * masking)
    return total * fresnel * n_dot_l


def widened_lobes(
    normals: Tensor, views: Tensor, lights: Tensor, specular: Tensor, roughness: Tensor, spread: Tensor
) -> Tensor:
    """Highlights without shadows [N, L] of facets under lights [L, 3]; normals, views [N, 3] are unit.

    specular, roughness [N]. `spread` [N], the variance of the normals within a facet, widens the lobe
    (Tokuyoshi and Kaplanyan, *Improved geometric specular antialiasing*, 2019).
    """
    l_dot_v = views @ lights.T
    to_half = (2 + 2 * l_dot_v).clamp_min(1e-6).rsqrt()
    n_dot_l, n_dot_v = normals @ lights.T, (normals * views).sum(1, keepdim=True)
    cosines = Cosines(
        n_dot_l=n_dot_l.clamp_min(0),
        n_dot_v=n_dot_v.clamp_min(0.05),
        n_dot_h=((n_dot_l + n_dot_v) * to_half).clamp(0, 1),
        v_dot_h=((1 + l_dot_v) * to_half).clamp(0, 1),
    )
    widened = roughness**4 + (2 * spread).clamp_max(_NORMAL_VARIANCE)
    return two_lobes(cosines, specular[:, None], widened[:, None] ** 0.25)


def _smith(cosine: Tensor, alpha_squared: Tensor) -> Tensor:
    """2 cosine / G1, with Smith's masking G1 of equation 34 of Walter et al."""
    return cosine + (alpha_squared + (1 - alpha_squared) * cosine**2).sqrt()


def strand_cosines(tangents: Tensor, normals: Tensor, lights: Tensor) -> Tensor:
    """Compute the diffuse factor of hair [N, L], which replaces n.l.

    It is the sine of Kajiya and Kay (*Rendering fur*, 1989), wrapped by the normal of the hair volume as by
    Scheuermann (*Hair rendering and shading*, 2004). tangents and normals [N, 3] and lights [L, 3] are unit.
    """
    sines = (1 - (tangents @ lights.T) ** 2).clamp_min(0).sqrt()
    return sines * (0.25 + 0.75 * (normals @ lights.T)).clamp_min(0)


class Strands(NamedTuple):
    """N points on hair: unit tangents toward the tip and unit views [N, 3], specular and roughness [N]."""

    tangents: Tensor
    views: Tensor
    specular: Tensor
    roughness: Tensor


def strand_highlights(hair: Strands, lights: Tensor) -> tuple[Tensor, Tensor]:
    """Compute specular radiance [N, L] under lights [L, 3]: a white highlight, and one to tint by the hair.

    These are the lobes R, and TRT and TT to tint, of Marschner et al. (*Light scattering from human hair
    fibers*, 2003): Gaussians in the half angle along the strand; around it cos(phi / 2) / 4 for R and, as a
    simplification, TRT, and for TT, the light that shines through, a Gaussian about the direction away from
    the light.
    """
    sin_l, sin_v = hair.tangents @ lights.T, (hair.tangents * hair.views).sum(-1, keepdim=True)
    sin_l, sin_v = sin_l.clamp(-0.999, 0.999), sin_v.clamp(-0.999, 0.999)
    theta_l, theta_v = sin_l.asin(), sin_v.asin()
    cos_l, cos_v = theta_l.cos(), theta_v.cos()
    cos_phi = ((hair.views @ lights.T - sin_l * sin_v) / (cos_l * cos_v)).clamp(-1, 1)
    cos_half_phi = ((1 + cos_phi) / 2).sqrt()
    cos_difference = ((theta_l - theta_v) / 2).cos()
    incidence = (cos_half_phi * cos_difference).clamp(0, 1)
    fresnel = hair.specular[:, None] + (1 - hair.specular[:, None]) * (1 - incidence) ** 5
    around = math.pi * cos_l * cos_half_phi / (4 * cos_difference**2)
    half, width = (theta_l + theta_v) / 2, (hair.roughness[:, None] ** 2).clamp_min(0.06)
    # Half a Gaussian: the half angle changes half as fast as the angle that a lobe integrates to 1 over.
    white, coloured, through = (
        _gaussian(half - shift, width * spread) / 2 for shift, spread in _STRAND_LOBES
    )
    behind = _gaussian(math.pi - cos_phi.acos(), torch.tensor(_TRANSMITTED_WIDTH))
    through = _TRANSMITTED * math.pi * cos_l / cos_difference**2 * behind * through
    tinted = (1 - fresnel) ** 2 * hair.specular[:, None] * around * coloured
    return fresnel * around * white, tinted + (1 - hair.specular[:, None]) ** 2 * through


def _gaussian(angle: Tensor, sigma: Tensor) -> Tensor:
    return torch.exp(-0.5 * (angle / sigma) ** 2) / (math.sqrt(2 * math.pi) * sigma)


def tilt_normals(normals: Tensor, tangents_u: Tensor, tangents_v: Tensor, relief: Tensor) -> Tensor:
    """Tilt unit normals [B, 3, T, T] by slopes [B, 2, T, T] along unit tangents [B, 3, T, T]."""
    return unit_along(normals - relief[:, :1] * tangents_u - relief[:, 1:] * tangents_v, 1)


def unit_along(vectors: Tensor, dim: int) -> Tensor:
    """Scale vectors to length 1 along `dim`; much faster than `F.normalize` along a strided dimension."""
    return vectors * (vectors * vectors).sum(dim, keepdim=True).clamp_min(1e-12).rsqrt()
