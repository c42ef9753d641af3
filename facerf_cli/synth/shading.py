"""The shadows of lids and lashes on open eyes, which the chart, one smooth sheet over both, does not cast.

Radiance of a skin under baked lights: shadowed diffuse, one bounce, scattering, two glossy lobes.
"""

import math
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from facerf_cli.face.topology import CHART_MM
from facerf_cli.raster.texture import texel_centres_uv
from facerf_cli.synth.appearance.skin import Skin
from facerf_cli.synth.random_fields import CHART_SPAN, Window, mask

_LIDS_MM, _LASHES_MM = 3.0, 7.0  # how far they stand off the eye
_LASHES_PASS = 0.6  # the share of the light between them
_GRAZING = 0.15  # light less steep than this does not get further under


def lid_shadows(directions: Tensor, side: int) -> Tensor:
    """What lids and lashes let through [L, T, T] of lights in the head frame [L, 3]; 1 off the eyes.

    A point of the eye is lit where the opening, seen from it along the light, is still the opening.
    """
    opening = mask(Window(side, CHART_SPAN), "eyes", 1.5)  # [1, 1, T, T]
    rows = opening[0, 0].amax(1).nonzero()[:, 0]
    band = slice(int(rows[0]), int(rows[-1]) + 1)  # the eyes' rows
    slope = directions[:, :2] / directions[:, 2:].clamp_min(_GRAZING)  # millimetres aside for one of height
    aside_uv = slope * torch.tensor([1.0, -1.0]) / torch.as_tensor(CHART_MM, dtype=torch.float32)
    lids, lashes = (_moved(opening, reach_mm * aside_uv, band) for reach_mm in (_LIDS_MM, _LASHES_MM))
    passed = lids * (_LASHES_PASS + (1 - _LASHES_PASS) * lashes)
    through = torch.ones(len(directions), side, side)
    through[:, band] -= opening[0, :, band] * (1 - passed)
    return through


def _moved(field: Tensor, by_uv: Tensor, rows: slice) -> Tensor:
    """Rows of a field [1, 1, T, T] as they are at places moved by [L, 2]: [L, R, T]."""
    places = texel_centres_uv(field.shape[-1])[rows] + by_uv[:, None, None]
    return F.grid_sample(field.expand(len(by_uv), -1, -1, -1), 2 * places - 1, align_corners=False)[:, 0]


LOBES = ((1.0, 0.75), (0.55, 0.25))  # (roughness factor, weight): a broad lobe and an oily one
_STRAND_LOBES = ((-0.12, 1.0), (0.17, 2.0))  # (shift in radians toward the tip, width factor)


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
    cosines = Cosines(n_dot_l, n_dot_v, n_dot_h, v_dot_h)
    return two_lobes(cosines, skin.specular, skin.roughness)


class Cosines(NamedTuple):
    """Between normal n, light l, view v and half vector h, of any shapes that broadcast; all in 0..1."""

    n_dot_l: Tensor
    n_dot_v: Tensor
    n_dot_h: Tensor
    v_dot_h: Tensor


def two_lobes(cosines: Cosines, specular: Tensor, roughness: Tensor) -> Tensor:
    """The radiance of `highlights` from its cosines, for any shapes that broadcast."""
    n_dot_l, n_dot_v, n_dot_h, v_dot_h = cosines
    away = 1 - v_dot_h
    fresnel = specular + (1 - specular) * (away * away).square() * away
    total = torch.zeros_like(n_dot_l)
    for factor, weight in LOBES:
        alpha_squared = (roughness * factor) ** 4
        spread = (n_dot_h.square() * (alpha_squared - 1) + 1).square()  # of GGX: alpha^2 / (pi spread)
        masking = _smith(n_dot_l, alpha_squared) * _smith(n_dot_v, alpha_squared)
        total += (weight * alpha_squared) / (spread * masking)
    return total * fresnel * n_dot_l


def _smith(cosine: Tensor, alpha_squared: Tensor) -> Tensor:
    """2 cosine / G1 of Smith's masking, equation 34 of Walter et al."""
    return cosine + (alpha_squared + (1 - alpha_squared) * cosine**2).sqrt()


def strand_cosines(tangents: Tensor, normals: Tensor, lights: Tensor) -> Tensor:
    """What takes the place of n.l for hair [N, L]: strands [N, 3] in a volume with normals [N, 3].

    Kajiya and Kay's sine (*Rendering fur*, 1989), wrapped by the volume's normal as Scheuermann has it (*Hair
    rendering and shading*, 2004), for all unit.
    """
    sines = (1 - (tangents @ lights.T) ** 2).clamp_min(0).sqrt()
    return sines * (0.25 + 0.75 * (normals @ lights.T)).clamp_min(0)


class Strands(NamedTuple):
    """Hair at N points: unit tangents toward the tip and unit views [N, 3], specular and roughness [N]."""

    tangents: Tensor
    views: Tensor
    specular: Tensor
    roughness: Tensor


def strand_highlights(hair: Strands, lights: Tensor) -> tuple[Tensor, Tensor]:
    """Specular radiance [N, L] of lights [L, 3] of rgb 1: the white highlight and the one that hair colours.

    The R and, simplified to a second shifted copy, TRT lobes of Marschner et al. (*Light scattering from
    human hair fibers*, 2003): a Gaussian in the half angle along the strand, cos(phi / 2) / 4 around it.
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
    white, coloured = (around * _gaussian(half - shift, width * spread) for shift, spread in _STRAND_LOBES)
    return fresnel * white, (1 - fresnel) ** 2 * hair.specular[:, None] * coloured


def _gaussian(angle: Tensor, sigma: Tensor) -> Tensor:
    return torch.exp(-0.5 * (angle / sigma) ** 2) / (math.sqrt(2 * math.pi) * sigma)


def bend(normals: Tensor, tangents_u: Tensor, tangents_v: Tensor, relief: Tensor) -> Tensor:
    """Normals [B, 3, T, T] tilted by slopes [B, 2, T, T] of fine relief along unit tangents [B, 3, T, T]."""
    return unit(normals - relief[:, :1] * tangents_u - relief[:, 1:] * tangents_v, 1)


def unit(vectors: Tensor, dim: int) -> Tensor:
    """Vectors scaled to length 1 along `dim`; many times faster than `normalize` over a strided one."""
    return vectors * (vectors * vectors).sum(dim, keepdim=True).clamp_min(1e-12).rsqrt()
