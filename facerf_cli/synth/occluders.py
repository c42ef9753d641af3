"""Objects in front of the face, painted into the skin textures of samples: fringes and rims of glasses.

They are relit as dark matte surfaces on the face; a texture cannot show their distance from it.
"""

from dataclasses import replace

import torch
from torch import Tensor

from facerf_cli.synth.appearance.skin import Skin
from facerf_cli.synth.random_fields import LANDMARK_MM, Uniform, Window, noise, places_mm, smooth

_FRINGES, _GLASSES = 0.15, 0.08  # share of faces with each
_BROW_MM = float(LANDMARK_MM[17:27, 1].mean())
_EYE_MM = (float(abs(LANDMARK_MM[36:48, 0]).mean()), float(LANDMARK_MM[36:48, 1].mean()))


def with_occluders(skin: Skin, window: Window, generator: torch.Generator) -> Skin:
    """Cover some of the skins by a fringe or by glasses."""
    count = len(skin.albedo)
    uniform = Uniform(generator, (count, 1, 1, 1))
    fringed, spectacled = uniform(0, 1) < _FRINGES, uniform(0, 1) < _GLASSES
    strands = noise(count, window, (1.5, 40), generator, octaves=2)
    ragged = noise(count, window, (10, 30), generator, octaves=2)
    _, y = places_mm(window)
    lower_mm = _BROW_MM + uniform(-35, 8) + 4 * ragged
    fringe = smooth((lower_mm - y) / 4 + 0.5 + 0.4 * strands) * fringed
    colour = uniform(0.01, 0.12) * (1 + 0.35 * strands).clamp(0.3, 2) * uniform(0.6, 1, count, 3, 1, 1)
    rims = _rims(window, uniform(17, 25), uniform(11, 20), uniform(0.6, 1.8)) * spectacled
    skin = _covered(skin, fringe, colour, 0.5)
    return _covered(skin, rims, uniform(0.005, 0.3, count, 3, 1, 1).expand_as(skin.albedo), 0.25)


def _covered(skin: Skin, cover: Tensor, albedo: Tensor, roughness: float) -> Skin:
    """Blend the skin toward a flat surface by its cover [B, 1, T, T]."""
    return replace(
        skin,
        albedo=skin.albedo + cover * (albedo - skin.albedo),
        roughness=skin.roughness + cover * (roughness - skin.roughness),
        relief=skin.relief * (1 - cover),
    )


def _rims(window: Window, width_mm: Tensor, height_mm: Tensor, line_mm: Tensor) -> Tensor:
    """Cover [B, 1, T, T] of two rims and their bridge; width and height are measured from a rim's centre."""
    x, y = places_mm(window)
    dx, dy = x.abs() - _EYE_MM[0], y - _EYE_MM[1] - 2
    radius = ((dx / width_mm) ** 4 + (dy / height_mm) ** 4) ** 0.25  # a rounded rectangle
    from_rim_mm = (radius - 1).abs() * torch.minimum(width_mm, height_mm)
    bridge_mm = (dy + 3).abs() + 1e3 * (x.abs() > _EYE_MM[0] - width_mm)
    half_line = line_mm.clamp_min(max(window.texel_mm) / 2)
    return smooth(1.5 - torch.minimum(from_rim_mm, bridge_mm) / half_line)
