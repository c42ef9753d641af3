"""Procedural skin in the canonical chart: from pigments to albedo, gloss and fine relief, drawn at random.

Albedo follows Beer-Lambert: two pigments (melanin, haemoglobin) over a pale dermis, each with an absorbance
per channel of linear Rec.709. Absorbances are rounded from the published spectra of both pigments (S.
Jacques, *Optical properties of biological tissues: a review*, 2013) at 610, 550 and 465 nm.
"""

from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor

from facerf_cli.face.regions import region_mask
from facerf_cli.face.topology import LANDMARK_UV
from facerf_cli.raster.texture import texel_centres_uv

_DERMIS = (0.86, 0.76, 0.68)  # linear Rec.709
_MELANIN = (0.62, 0.92, 1.35)  # absorbance per channel of one unit; skins hold 0 to `_DARKEST`
_DARKEST = 2.8
_HAEMOGLOBIN = (0.05, 0.38, 0.30)
_HAIR_COLOURS = (
    (0.012, 0.010, 0.009),
    (0.045, 0.025, 0.015),
    (0.12, 0.07, 0.035),
    (0.30, 0.21, 0.11),
    (0.25, 0.24, 0.23),
)
_HAIR_SHARES = (0.4, 0.25, 0.15, 0.1, 0.1)
_PAINTED = ("eyes", "brows", "lips", "mouth", "nostrils", "neck")
_EYE_CORNERS = ((36, 39), (42, 45))


@dataclass(frozen=True)
class Skin:
    """Material maps in UV of B faces.

    albedo [B, 3, T, T] linear Rec.709; specular [B, 1, T, T] reflectance at normal incidence; roughness
    [B, 1, T, T] (GGX alpha is its square); relief [B, 2, T, T] slopes of the surface along u and v;
    scattering_texels [B, 3]: how far each channel's light spreads under the surface.
    """

    albedo: Tensor
    specular: Tensor
    roughness: Tensor
    relief: Tensor
    scattering_texels: Tensor


def draw_skin(faces: int, side: int, generator: torch.Generator) -> Skin:
    """Draw B skins on a chart of `side` texels, tones from light to dark evenly."""
    uniform = _Uniform(faces, generator)
    coarse = noise(faces, side, 6, generator)
    middle = noise(faces, side, 24, generator)
    fine = torch.randn(faces, 1, side, side, generator=generator)
    masks = {name: region_mask(name, side)[None, None] for name in _PAINTED}

    melanin = uniform(0.05, 1.0) ** 1.4 * _DARKEST
    melanin = melanin * (1 + uniform(0.02, 0.14) * coarse + uniform(0.02, 0.08) * middle) + _spots(
        middle, fine, uniform
    )
    blood = uniform(0.3, 1.1) * (
        1 + uniform(0.05, 0.3) * noise(faces, side, 6, generator) + 0.5 * _flush(side) * uniform(0, 1)
    )
    melanin = melanin + masks["lips"] * uniform(-0.1, 0.35)
    blood = blood + masks["lips"] * uniform(0.3, 1.6)
    albedo = _pigmented(melanin, blood) * (1 + 0.03 * fine)
    albedo = _make_up(albedo, masks, uniform)

    hair, hair_colour = _hair_mask(side, masks, coarse, middle, fine, uniform, generator)
    albedo = albedo * (1 - hair) + hair * hair_colour * (1 + 0.5 * fine)
    albedo = albedo * (1 - 0.85 * masks["nostrils"])
    clothed = masks["neck"] * (uniform(0, 1) < 0.4)
    albedo = albedo * (1 - clothed) + clothed * uniform(0.02, 0.6, channels=3)
    albedo = _random_textures(albedo, coarse, middle, uniform, generator)
    teeth_or_dark = torch.where(uniform(0, 1) < 0.5, uniform(0.35, 0.7), uniform(0.02, 0.1))
    albedo = albedo * (1 - masks["mouth"]) + masks["mouth"] * teeth_or_dark
    eye_albedo = _eyes(side, masks["eyes"], uniform)
    albedo = (albedo * (1 - masks["eyes"]) + masks["eyes"] * eye_albedo).clamp(0.005, 0.95)
    return _with_gloss(albedo, hair, masks, middle, fine, uniform)


class _Uniform:
    """Draws one uniform number a face, shaped to broadcast over [B, C, T, T]."""

    def __init__(self, faces: int, generator: torch.Generator) -> None:
        self.faces, self.generator = faces, generator

    def __call__(self, low: float, high: float, channels: int = 1) -> Tensor:
        drawn = torch.rand(self.faces, channels, 1, 1, generator=self.generator)
        return low + (high - low) * drawn


def noise(faces: int, side: int, cells: int, generator: torch.Generator) -> Tensor:
    """Smooth noise [B, 1, T, T] of unit deviation with about `cells` bumps a side and two finer octaves."""
    total = torch.zeros(faces, 1, side, side)
    for octave, weight in enumerate((1.0, 0.5, 0.25)):
        size = min(cells * 2**octave, side)
        grid = torch.randn(faces, 1, size, size, generator=generator)
        total += weight * F.interpolate(grid, (side, side), mode="bicubic", align_corners=False)
    return total / 0.9


def _pigmented(melanin: Tensor, blood: Tensor) -> Tensor:
    dermis, mel, haem = (torch.tensor(x).view(1, 3, 1, 1) for x in (_DERMIS, _MELANIN, _HAEMOGLOBIN))
    return dermis * torch.exp(-melanin.clamp_min(0) * mel - blood.clamp_min(0) * haem)


def _blob(side: int, landmark: int | tuple[float, float], radius: float) -> Tensor:
    u, v = texel_centres_uv(side).unbind(-1)
    at = LANDMARK_UV[landmark] if isinstance(landmark, int) else landmark
    return torch.exp(-(((u - at[0]) / radius) ** 2 + ((v - at[1]) / radius) ** 2))


def _flush(side: int) -> Tensor:
    """Where blood shows: cheeks, nose tip, chin [1, 1, T, T]."""
    cheeks = _blob(side, (0.27, 0.55), 0.10) + _blob(side, (0.73, 0.55), 0.10)
    return (cheeks + _blob(side, 30, 0.05) + 0.5 * _blob(side, 8, 0.07))[None, None]


def _spots(middle: Tensor, fine: Tensor, uniform: _Uniform) -> Tensor:
    """Freckles and a few moles, as extra melanin."""
    blurred = F.avg_pool2d(fine, 3, 1, 1) * 3
    freckled = (uniform(0, 1) < 0.2) * torch.sigmoid(6 * (blurred + middle - 1.8)) * uniform(0.1, 0.5)
    moles = torch.sigmoid(12 * (blurred - 3.6)) * uniform(0.5, 1.5)
    return freckled + moles


def _make_up(albedo: Tensor, masks: dict[str, Tensor], uniform: _Uniform) -> Tensor:
    worn = (uniform(0, 1) < 0.2).float()
    lipstick = uniform(0.05, 0.7, channels=3) * torch.tensor([1.0, 0.35, 0.4]).view(1, 3, 1, 1)
    cover = worn * masks["lips"] * uniform(0.3, 0.9)
    return albedo * (1 - cover) + cover * lipstick


def _hair_mask(
    side: int,
    masks: dict[str, Tensor],
    coarse: Tensor,
    middle: Tensor,
    fine: Tensor,
    uniform: _Uniform,
    generator: torch.Generator,
) -> tuple[Tensor, Tensor]:
    """Cover [B, 1, T, T] of brows, beard, hairline and fringe, and the hair's colour [B, 3, 1, 1]."""
    u, v = texel_centres_uv(side).unbind(-1)
    palette = torch.tensor(_HAIR_COLOURS)
    index = torch.multinomial(torch.tensor(_HAIR_SHARES), uniform.faces, True, generator=generator)
    colour = palette[index].view(-1, 3, 1, 1) * uniform(0.7, 1.4)
    streaks = 0.8 + 0.25 * fine + 0.2 * middle
    brows = masks["brows"] * uniform(0.3, 1.1) * streaks
    lower = torch.sigmoid(40 * (v - 0.62 - 0.9 * (0.5 - (u - 0.5).abs()).clamp(0, 0.2)))[None, None]
    moustache = _blob(side, 33, 0.06)[None, None] * (v > 0.6)
    grown = (uniform(0, 1) < 0.3) * uniform(0.1, 0.9) ** 2
    beard = (
        (lower + 0.8 * moustache).clamp(0, 1)
        * (1 - masks["lips"])
        * grown
        * (0.8 + 0.3 * middle + 0.3 * fine)
    )
    edge_distance = torch.maximum(0.10 - v, 1.5 * ((u - 0.5).abs() - 0.44))[None, None]
    line = uniform(-0.12, 0.10) + 0.03 * coarse
    scalp = torch.sigmoid(60 * (edge_distance + line)) * (0.9 + 0.1 * fine) * (uniform(0, 1) < 0.75)
    cover = torch.maximum(torch.maximum(brows, beard), scalp).clamp(0, 0.97)
    return cover * (1 - masks["eyes"]), colour


def _random_textures(
    albedo: Tensor, coarse: Tensor, middle: Tensor, uniform: _Uniform, generator: torch.Generator
) -> Tensor:
    """A share of faces wears random colours, so that nothing is read off skin tone alone."""
    side = albedo.shape[-1]
    coloured = torch.cat([noise(uniform.faces, side, 5, generator) for _ in range(3)], 1)
    painted = (0.35 + 0.12 * coloured + 0.05 * middle + 0.05 * coarse).clamp(0.02, 0.9)
    return torch.where(uniform(0, 1) < 0.07, painted, albedo)


def _eyes(side: int, mask: Tensor, uniform: _Uniform) -> Tensor:
    """Sclera, iris and pupil, with one gaze for both eyes [B, 3, T, T]."""
    u, v = texel_centres_uv(side).unbind(-1)
    iris_colour = (
        uniform(0.01, 0.22) * torch.tensor([1.0, 0.85, 0.75]).view(1, 3, 1, 1) * uniform(0.6, 1.4, channels=3)
    )
    shift_u, shift_v = uniform(-0.012, 0.012), uniform(-0.006, 0.006)
    sclera = uniform(0.3, 0.65) * torch.tensor([1.0, 0.93, 0.88]).view(1, 3, 1, 1)
    eye = sclera.expand(-1, 3, side, side)
    for inner, outer in _EYE_CORNERS:
        centre = LANDMARK_UV[[inner, outer]].mean(0)
        radius = (((u - centre[0] - shift_u) / 0.026) ** 2 + ((v - centre[1] - shift_v) / 0.034) ** 2).sqrt()
        iris, pupil = torch.sigmoid(14 * (1 - radius)), torch.sigmoid(14 * (0.42 - radius))
        eye = eye * (1 - iris) + iris * iris_colour * (1 - 0.9 * pupil)
    lashes = 4 * mask * (1 - mask)
    return eye * (1 - 0.7 * lashes)


def _with_gloss(
    albedo: Tensor, hair: Tensor, masks: dict[str, Tensor], middle: Tensor, fine: Tensor, uniform: _Uniform
) -> Skin:
    faces, _, side, _ = albedo.shape
    t_zone = (_blob(side, 30, 0.07) + _blob(side, 27, 0.10) + 0.7 * _blob(side, (0.5, 0.12), 0.16))[
        None, None
    ]
    oil = uniform(0.5, 1.5)
    specular = 0.026 * oil * (0.8 + 0.6 * t_zone + 0.8 * masks["lips"] + 0.2 * middle).clamp_min(0.2)
    specular = specular * (1 - 0.7 * hair) * (1 - 0.8 * masks["nostrils"])
    specular = specular * (1 - masks["eyes"]) + 0.035 * masks["eyes"]
    roughness = (0.52 - 0.10 * (oil - 1) - 0.08 * t_zone - 0.10 * masks["lips"] + 0.04 * middle).clamp(
        0.28, 0.7
    )
    roughness = roughness * (1 - masks["eyes"]) + 0.22 * masks["eyes"]
    relief_height = (0.5 * fine + 0.5 * middle) * uniform(0.1, 1) * (1 - masks["eyes"])
    relief = torch.cat(
        [relief_height.roll(-1, -1) - relief_height, relief_height.roll(-1, -2) - relief_height], 1
    )
    scattering = uniform(0.5, 1.3).view(faces, 1) * torch.tensor([[1.7, 0.9, 0.6]]) * side / 128
    return Skin(albedo, specular, roughness, 0.09 * relief, scattering)
