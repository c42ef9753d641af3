"""Radiance of a skin under baked lights: shadowed diffuse, one bounce, scattering, two glossy lobes."""

import math

import torch
import torch.nn.functional as F
from torch import Tensor

from facerf_cli.stage.skin import Skin

_LOBES = ((1.0, 0.75), (0.55, 0.25))  # (roughness factor, weight): a broad lobe and an oily one


def diffuse_irradiance(
    visibility: Tensor, bounce: Tensor, cosines: Tensor, albedo: Tensor, weights: Tensor
) -> Tensor:
    """Irradiance [3, T, T] of one face under L lights of rgb `weights` [L, 3].

    visibility, bounce, cosines: [L, T, T]; the bounce is tinted by the face's mean albedo (albedo [3, T, T]).
    """
    tint = albedo.mean((1, 2))[:, None]  # [3, 1]
    direct = weights.T @ (visibility * cosines.clamp_min(0)).flatten(1)
    returned = weights.T @ bounce.flatten(1)
    return (direct + tint * returned).view(3, *visibility.shape[1:])


def scatter(irradiance: Tensor, sigma_texels: Tensor) -> Tensor:
    """Spread irradiance [B, 3, T, T] under the surface by a Gaussian a channel, sigma [B, 3] in texels."""
    faces, channels, side, _ = irradiance.shape
    reach = 6
    offset = torch.arange(-reach, reach + 1)
    kernel = torch.exp(-0.5 * (offset / sigma_texels.reshape(-1, 1)) ** 2)
    kernel = kernel / kernel.sum(-1, keepdim=True)
    flat = F.pad(irradiance.reshape(1, -1, side, side), (reach,) * 4, mode="replicate")
    groups = faces * channels
    flat = F.conv2d(flat, kernel.view(groups, 1, 1, -1), groups=groups)
    flat = F.conv2d(flat, kernel.view(groups, 1, -1, 1), groups=groups)
    return flat.view(faces, channels, side, side)


def highlights(normals: Tensor, views: Tensor, lights: Tensor, skin: Skin) -> Tensor:
    """Specular radiance [B, L, T, T] of directional lights [B, L, 3] of rgb 1 (irradiance pi, as in DESIGN).

    Two GGX lobes with Smith shadowing and Schlick's Fresnel (Walter et al., *Microfacet models*, 2007).
    normals and views are unit fields [B, 3, T, T] in the lights' frame.
    """
    n_dot_v = (normals * views).sum(1, keepdim=True).clamp_min(0.05)
    half = unit(lights[..., None, None] + views[:, None], 2)  # [B, L, 3, T, T]
    n_dot_h = (half * normals[:, None]).sum(2).clamp(0, 1)
    v_dot_h = (half * views[:, None]).sum(2).clamp(0, 1)
    n_dot_l = torch.einsum("blc,bcij->blij", lights, normals).clamp_min(0)
    fresnel = skin.specular + (1 - skin.specular) * (1 - v_dot_h) ** 5
    total = torch.zeros_like(n_dot_l)
    for factor, weight in _LOBES:
        alpha_squared = (skin.roughness * factor) ** 4
        distribution = alpha_squared / (math.pi * (n_dot_h**2 * (alpha_squared - 1) + 1) ** 2)
        k = skin.roughness * factor / 2
        masking = 1 / ((n_dot_l * (1 - k) + k) * (n_dot_v * (1 - k) + k))
        total += weight * distribution * masking / 4
    return math.pi * total * fresnel * n_dot_l


def bend(normals: Tensor, tangents_u: Tensor, tangents_v: Tensor, relief: Tensor) -> Tensor:
    """Normals [B, 3, T, T] tilted by slopes [B, 2, T, T] of fine relief along unit tangents [B, 3, T, T]."""
    return unit(normals - relief[:, :1] * tangents_u - relief[:, 1:] * tangents_v, 1)


def unit(vectors: Tensor, dim: int) -> Tensor:
    """Vectors scaled to length 1 along `dim`; many times faster than `normalize` over a strided one."""
    return vectors * (vectors * vectors).sum(dim, keepdim=True).clamp_min(1e-12).rsqrt()
