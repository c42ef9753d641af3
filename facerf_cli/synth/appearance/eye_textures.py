"""Textures of eyes: a separate eyeball, or eyes painted flat between the lids of the face's texture."""

import math

import torch
from torch import Tensor

from facerf_cli.raster.texture import texel_centres_uv
from facerf_cli.synth.appearance.people import People
from facerf_cli.synth.random_fields import LANDMARK_MM, Uniform, Window, mask, places_mm, plain_noise

_CORNERS = ((36, 39), (42, 45))  # landmarks of the eyes' corners
IRIS_DEG = 29.0  # edge of the iris, from the gaze axis
_RADIUS_MM = 12.0  # of the eyeball
# Colours of irises, linear Rec.709.
_BROWN, _AMBER = (0.055, 0.026, 0.012), (0.16, 0.085, 0.030)
_GREEN, _BLUE, _GREY = (0.11, 0.115, 0.055), (0.10, 0.155, 0.22), (0.15, 0.17, 0.18)
_IRISES = {"brown": _BROWN, "amber": _AMBER, "green": _GREEN, "blue": _BLUE, "grey": _GREY}
_FAIR_SHARES = (0.35, 0.15, 0.15, 0.25, 0.10)  # frequency among fair people; all others are brown


def draw_irises(people: People, generator: torch.Generator) -> tuple[Tensor, list[str]]:
    """Draw iris colours [B, 3], linear Rec.709, and their names."""
    count = len(people.melanin)
    names = list(_IRISES)
    fair = torch.multinomial(torch.tensor(_FAIR_SHARES), count, True, generator=generator)
    dark = (people.melanin > 0.035) | (people.hair_eumelanin > 4)
    index = torch.where(dark, 0, fair)
    palette = torch.tensor(list(_IRISES.values()))
    shade = torch.exp(0.25 * torch.randn(count, 1, generator=generator))
    return palette[index] * shade, [names[int(i)] for i in index]


def eyeball_textures(
    side: int, people: People, generator: torch.Generator
) -> tuple[tuple[Tensor, Tensor, Tensor, Tensor], dict[str, float | str | bool]]:
    """Draw albedo, specular, roughness and relief [C, T, T] of the first person's eyes, and their traits.

    The texture is a disc around the gaze axis, azimuthal equidistant to 90 degrees at its edge.
    """
    colours, names = draw_irises(people, generator)
    offset = (texel_centres_uv(side) - 0.5) * 180  # degrees
    angle = offset.norm(dim=-1)
    turn = torch.atan2(offset[..., 1], offset[..., 0])
    pupil_deg = float(7.5 + 3.5 * torch.rand((), generator=generator))
    redness = float(torch.rand((), generator=generator) ** 2)
    sclera = _sclera(side, angle, redness, float(people.age[0]), generator)
    iris = _iris(angle, turn, pupil_deg, colours[0], generator)
    edge = torch.sigmoid((IRIS_DEG - angle) / 0.7)
    albedo = sclera + edge * (iris - sclera)
    wet = torch.ones(1, side, side)
    relief = 0.01 * torch.cat([plain_noise((side, side), 14, generator) for _ in range(2)])
    relief = relief * (angle > IRIS_DEG)
    pupil_mm = 2 * _RADIUS_MM * math.radians(pupil_deg)
    traits: dict[str, float | str | bool] = {"iris": names[0], "pupil_mm": round(pupil_mm, 2)}
    roughness = torch.where(angle < IRIS_DEG, 0.08, 0.14)[None]
    return (albedo.clamp(0.003, 0.9), 0.03 * wet, roughness, relief), traits


def _sclera(side: int, angle: Tensor, redness: float, age: float, generator: torch.Generator) -> Tensor:
    """Albedo [3, T, T] of the sclera: off-white, yellower with age, with more pink and veins off the iris."""
    young, old = torch.tensor([0.50, 0.46, 0.44]), torch.tensor([0.47, 0.41, 0.33])
    base = (young + (old - young) * (age - 18) / 57 * 0.8).view(3, 1, 1)
    ridges = 1 - plain_noise((side, side), 26, generator).abs() * 3
    veins = ridges.clamp(0, 1) ** 3 * torch.sigmoid((angle - 45) / 7)
    pink = (0.10 + 0.35 * redness) * torch.sigmoid((angle - 58) / 9) + (0.25 + 0.5 * redness) * veins
    return base * (1 - pink * torch.tensor([0.12, 0.75, 0.70]).view(3, 1, 1))


def _iris(
    angle: Tensor, turn: Tensor, pupil_deg: float, colour: Tensor, generator: torch.Generator
) -> Tensor:
    """Albedo [3, T, T] of iris and pupil: radial fibres, a collarette and a limbal ring."""
    fibres = torch.zeros_like(angle)
    for waves in (17, 31, 53, 89):
        phase = 2 * torch.pi * torch.rand((), generator=generator)
        bend = float(torch.randn((), generator=generator)) * 0.04
        fibres = fibres + torch.cos(waves * turn + phase + bend * angle) * (31 / waves) ** 0.5
    fibres = 1 + 0.14 * fibres
    out = ((angle - pupil_deg) / (IRIS_DEG - pupil_deg)).clamp(0, 1)
    collarette = 0.35 * torch.exp(-(((out - 0.25) / 0.15) ** 2))
    rim = 1 - 0.75 * torch.sigmoid((out - 0.86) * 22)
    warm = torch.tensor([1.25, 1.0, 0.75]).view(3, 1, 1)
    coloured = colour.view(3, 1, 1) * (1 + collarette * (warm - 0.6)) * fibres.clamp_min(0.3) * rim
    pupil = torch.sigmoid((pupil_deg - angle) / 0.5)
    return coloured * (1 - pupil) + 0.004 * pupil


def paint_eyes(albedo: Tensor, people: People, window: Window, generator: torch.Generator) -> Tensor:
    """The face's albedo [B, 3, T, T] with eyes painted between the lids; both have one gaze."""
    uniform = Uniform(generator, (len(albedo), 1, 1, 1))
    between = mask(window, "eyes", 1.0)
    colours, _ = draw_irises(people, generator)
    x, y = places_mm(window)
    shift_x, shift_y = uniform(-3, 3), uniform(-1, 1)
    eye = uniform(0.32, 0.58) * torch.tensor([1.0, 0.93, 0.88]).view(1, 3, 1, 1)
    eye = eye.expand(-1, 3, window.side, window.side)
    for inner, outer in _CORNERS:
        centre_x, centre_y = (float(mm) for mm in LANDMARK_MM[[inner, outer]].mean(0))
        out = (((x - centre_x - shift_x) / 6.4) ** 2 + ((y - centre_y - shift_y) / 6.0) ** 2).sqrt()
        iris, pupil = torch.sigmoid(14 * (1 - out)), torch.sigmoid(14 * (0.38 - out))
        eye = eye * (1 - iris) + iris * colours.view(-1, 3, 1, 1) * (1 - 0.9 * pupil)
    lashes = 4 * between * (1 - between)
    eye = eye * (1 - 0.7 * lashes)
    return albedo * (1 - between) + between * eye
