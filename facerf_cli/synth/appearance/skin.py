"""Procedural skin: from people's pigments, region by region, to albedo, gloss and fine relief.

The same code paints the UV map of the face, for the training bank, and the wider canvas of whole heads.
"""

from dataclasses import replace
from functools import lru_cache
from typing import TypeVar

import numpy as np
import torch
from scipy.interpolate import CubicSpline
from scipy.linalg import block_diag
from torch import Tensor

from facerf_cli.image.skin import skin_albedo
from facerf_cli.synth import tables_of
from facerf_cli.synth.appearance.facial_hair import FacialHair, above_hairline, draw_facial_hair, scalp_hair
from facerf_cli.synth.appearance.people import People, draw_people, each, hair_albedo, paint_eyes
from facerf_cli.synth.head.mesh import arc_lengths
from facerf_cli.synth.random_fields import (
    LANDMARK_MM,
    UV_SPAN,
    Uniform,
    Window,
    blob,
    blobs,
    blurred,
    inside,
    mask,
    noise,
    places_mm,
    slopes,
    smooth,
    splat,
)
from facerf_cli.synth.shading import Material, Skin

M = TypeVar("M", bound=Material)

_WRINKLE_WIDTH_MM = 0.9  # sigma of a wrinkle's profile
_STEP_MM = 0.4  # between sample points along a wrinkle
_FOLDS = tables_of(__file__)  # wrinkles by name
_FOREHEAD_MM = (-12.0, 0.0, 11.0)  # heights of the forehead's lines around a line above the brows
_FOREHEAD_HALF_MM = 46.0  # half length
_FOREHEAD_DEPTH_MM = 0.3
# Sigma of each channel's light under the skin: root mean square of the sum of Gaussians that
# d'Eon and Luebke fitted to skin (*GPU Gems 3*, ch. 14).
_SCATTERING_MM = (1.18, 0.26, 0.16)


def draw_relief(
    people: People, window: Window, pores: Tensor, bare: Tensor, generator: torch.Generator
) -> tuple[Tensor, Tensor]:
    """Draw slopes [B, 2, T, T] of the skin, and the depth [B, 1, T, T] of wrinkles, about 0..1.

    `pores` [B, 1, T, T] is noise with bumps of the size of pores; `bare` [B, 1, T, T] is 1 where skin is bare
    and 0 where hair covers it.
    """
    count = len(people.melanin)
    age = each((people.age - 18) / 57)
    grain = torch.randn(count, 1, window.side, window.side, generator=generator)
    dents = noise(count, window, 6.0, generator, octaves=1)
    coarse = 0.6 + 0.5 * age + 0.4 * each(people.oiliness)
    grain = 0.03 * min(1.0, min(window.texel_mm)) * grain
    # Pores are strong on nose, inner cheeks and chin, and weak near the eyes.
    strength = 0.9 * blob(window, 30, 15) + 0.7 * blobs(window, 0.37, 0.52, 22) + 0.4 * blob(window, 8, 14)
    height = coarse * ((0.55 + strength.clamp(0, 1)) * (grain + 0.022 * pores) + 0.014 * dents)
    lips = mask(window, "lips", 1.5)
    lines = noise(count, window, (1.7, 9.0), generator, octaves=1)
    height = height * (1 - lips) + lips * 0.07 * lines
    wrinkles = _wrinkles(people, window, generator)
    relief = slopes(height * bare - wrinkles * (1 - lips), window)
    return relief.clamp(-0.8, 0.8), (wrinkles / 0.6).clamp(0, 1.2)


@lru_cache(maxsize=1)  # all people share it
def _fold_lines() -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Join all K folds: control points [P, 2], basis [N, P], taper [N], fold index [N] and depth [K].

    Basis times control points gives the N sample points; taper scales the depth at each.
    The mirror image of a fold is a separate fold and follows it.
    """
    folds = [
        np.array([LANDMARK_MM[int(index)] + [dx, dy] for index, dx, dy in fold["points"]])
        for fold in _FOLDS.values()
    ]
    depths = [fold["depth_mm"] for fold in _FOLDS.values()]
    folds = [fold * [side, 1] for fold in folds for side in (1, -1)]
    depths = [depth for depth in depths for _ in "ab"]
    x = np.linspace(-_FOREHEAD_HALF_MM, _FOREHEAD_HALF_MM, 7)
    folds += [np.stack([x, 6 + above - 0.0015 * x**2], -1) for above in _FOREHEAD_MM]
    depths += [_FOREHEAD_DEPTH_MM] * len(_FOREHEAD_MM)
    bases, tapers, numbers = [], [], []
    for number, points in enumerate(folds):
        length = arc_lengths(points)
        at = np.arange(0, length[-1], _STEP_MM)
        bases.append(CubicSpline(length, np.eye(len(points)))(at))
        tapers.append(np.sin(np.pi * (0.1 + 0.8 * at / length[-1])) ** 1.5)
        numbers.append(np.full(len(at), number))
    return (
        torch.from_numpy(np.concatenate(folds)).float(),
        torch.from_numpy(block_diag(*bases)).float(),
        torch.from_numpy(np.concatenate(tapers)).float(),
        torch.from_numpy(np.concatenate(numbers)),
        torch.tensor(depths),
    )


def _wrinkles(people: People, window: Window, generator: torch.Generator) -> Tensor:
    """Draw the depth [B, 1, T, T] in millimetres of all wrinkles at each person's age."""
    points, basis, taper, fold, depth = _fold_lines()
    count, folds = len(people.age), len(depth)
    grown = ((people.age - 22) / 53).clamp_min(0)[:, None] ** 1.4
    jitter = 0.8 * torch.randn(count, *points.shape, generator=generator)
    pairs = (folds - len(_FOREHEAD_MM)) // 2
    common = torch.rand(count, pairs + 1, generator=generator)  # both sides of the face are similar
    common = torch.cat(
        [common[:, :-1].repeat_interleave(2, 1), common[:, -1:].expand(-1, folds - 2 * pairs)], 1
    )
    own = 0.7 + 0.6 * torch.rand(count, folds, generator=generator)
    strength = depth * (0.08 + 1.8 * grown) * (0.25 + common) * own
    places = basis @ (points + jitter)  # [B, N, 2]
    amount = strength[:, fold] * taper * _STEP_MM
    face = torch.arange(count).repeat_interleave(len(fold))
    layers = splat(window, places.view(-1, 2), amount.reshape(-1), face, count)
    # A line of amount a per millimetre, blurred by a Gaussian of sigma s, has the depth a / (s sqrt(2 pi)).
    return blurred(layers, window, _WRINKLE_WIDTH_MM) * (_WRINKLE_WIDTH_MM * (2 * np.pi) ** 0.5)


def draw_skin(faces: int, side: int, generator: torch.Generator) -> Skin:
    """Draw B people's skins as textures of `side` texels with painted eyes, evenly from light to dark.

    Their gloss varies more than in `paint_skin`, because highlights in photos vary as much.
    """
    people = draw_people(faces, generator)
    window = Window(side, UV_SPAN)
    skin = paint_skin(people, window, generator, painted_eyes=True)
    scalp = scalp_hair(people, window, above_hairline(people, window), generator)
    scalp = scalp * each(1 - people.bald) * (torch.rand(faces, 1, 1, 1, generator=generator) < 0.8)
    colour = hair_albedo(people.hair_eumelanin, people.hair_pheomelanin, people.grey)[..., None, None]
    skin = with_scalp(skin, scalp, colour, generator)
    clothed = mask(window, "neck", 5.0) * (torch.rand(faces, 1, 1, 1, generator=generator) < 0.4)
    cloth = 0.02 + 0.58 * torch.rand(faces, 3, 1, 1, generator=generator)
    slit = torch.where(torch.rand(faces, 1, 1, 1, generator=generator) < 0.5, 0.5, 0.06)
    albedo = skin.albedo * (1 - clothed) + clothed * cloth
    mouth = mask(window, "mouth", 1.0)
    albedo = albedo * (1 - mouth) + mouth * slit
    uniform = Uniform(generator, (faces, 1, 1, 1))
    shine = torch.exp(uniform(-0.5, 0.5))
    smoothness = 0.24 * uniform(0, 1) ** 2 - 0.06
    specular, roughness = skin.specular * shine, (skin.roughness - smoothness).clamp(0.16, 0.85)
    return replace(skin, albedo=albedo, specular=specular, roughness=roughness)


def with_scalp(skin: M, cover: Tensor, colour: Tensor, generator: torch.Generator) -> M:
    """Return the skin under short hair of a colour, with a cover [..., 1, T, T] in 0..1."""
    streaks = (1 + 0.2 * torch.randn(cover.shape, generator=generator)).clamp(0.3, 1.8)
    return replace(
        skin,
        albedo=skin.albedo + cover * (colour * streaks - skin.albedo),
        specular=skin.specular * (1 - 0.5 * cover),
        roughness=(skin.roughness + 0.15 * cover).clamp(max=0.85),
        relief=skin.relief * (1 - cover),
    )


def bare_skin(people: People) -> Tensor:
    """Mean albedo [B, 3] of people's skin, linear Rec.709, without features."""
    return skin_albedo(each(people.melanin), each(people.haemoglobin))[:, :, 0, 0]


def scattering_mm(people: People) -> Tensor:
    """Return the sigma [B, 3] of the Gaussian that spreads each channel's light under the skin."""
    return torch.tensor(_SCATTERING_MM).expand(len(people.melanin), 3).clone()


def paint_skin(people: People, window: Window, generator: torch.Generator, painted_eyes: bool) -> Skin:
    """Paint people's skin on a window; without painted eyes, paint lid rims around separate eyeballs."""
    count = len(people.melanin)
    coarse = noise(count, window, 38, generator)
    middle = noise(count, window, 9, generator)
    fine = torch.randn(count, 1, window.side, window.side, generator=generator)
    pores = noise(count, window, 2.0, generator, octaves=2)
    averaging = min(1.0, 2 / sum(window.texel_mm)) ** 1.5  # large texels average the grain out
    grain = (0.7 * pores + 0.3 * fine) * averaging
    melanin, blood = _pigments(people, window, coarse, middle, grain, generator)
    hair = draw_facial_hair(people, window, generator)
    relief, depth = draw_relief(people, window, pores, 1 - hair.cover, generator)
    melanin, blood = melanin * (1 + 0.3 * depth), blood * (1 + 0.4 * depth)
    albedo = skin_albedo(melanin, blood)
    cast = torch.tensor([1.0, 0.84, 0.70]).view(1, 3, 1, 1)  # hair under the skin absorbs more red
    albedo = albedo * torch.exp(-hair.shadow * _darkness(people) * cast)
    random = people.random_texture > 0
    if bool(random.any()):
        albedo[random] = _random_colours(int(random.sum()), window, coarse[random], middle[random], generator)
    albedo = _make_up(albedo, people, window)
    albedo = _with_hair(albedo, people, hair, fine, middle)
    albedo = _openings(albedo, window)
    if painted_eyes:
        albedo = paint_eyes(albedo, people, window, generator)
    else:
        albedo = _lid_rims(albedo, people, window)
    specular, roughness = _gloss(people, window, hair.cover, middle, fine, painted_eyes)
    sigma = scattering_mm(people) / (sum(window.texel_mm) / 2)
    eyes = mask(window, "eyes", 1.0) if painted_eyes else torch.zeros(1, 1, 1, 1)
    return Skin(albedo.clamp(0.005, 0.95), specular, roughness, relief * (1 - eyes), sigma)


def _pigments(
    people: People, window: Window, coarse: Tensor, middle: Tensor, fine: Tensor, generator: torch.Generator
) -> tuple[Tensor, Tensor]:
    """Draw melanin and blood [B, 1, T, T], with facial regions, blotches, freckles and moles."""
    count = len(people.melanin)
    even = 1 - 0.6 * each(people.foundation)
    uneven = each(people.blotches) * even
    age = each((people.age - 18) / 57)
    lips, lids = mask(window, "lips", 2.2), _around_eyes(window)
    forehead = blob(window, (0.5, 0.02), 55, 0.6)
    perimeter = smooth((inside(window, "face") - 26) / -40)
    melanin = 1 + uneven * (0.05 * coarse + 0.06 * middle) + 0.07 * even * fine
    melanin = melanin + 0.10 * even * forehead + 0.14 * even * perimeter + 0.30 * even * lids
    base = each(people.melanin)
    melanin = base * melanin.clamp_min(0.3) + _spots(people, window, middle, fine, age * even, generator)

    veins = (1 - noise(count, window, 7, generator, octaves=2).abs() * 2.5).clamp(0, 1) ** 2
    nose, cheeks = blob(window, 30, 13) + blobs(window, 0.455, 0.55, 7), blobs(window, 0.29, 0.52, 26)
    ears = blobs(window, 1.24, 0.42, 38, 1.2)
    flush = 1.2 * nose.clamp(0, 1) + 1.0 * cheeks + 0.35 * blob(window, 8, 14) + 0.8 * ears.clamp(0, 1)
    flush = flush * (0.4 + 0.8 * each(people.flush)) * even * (1 + 0.25 * middle)
    red = 1 + 0.9 * flush + uneven * (0.14 * coarse + 0.12 * middle) + 0.16 * even * fine
    red = red + 0.7 * lids * even + 0.5 * veins * (nose + cheeks).clamp(0, 1) * (0.3 + age) * uneven
    red = red - 0.2 * forehead
    blood = each(people.haemoglobin) * red.clamp_min(0.25)

    lines = noise(count, window, (1.8, 8.0), generator, octaves=1)
    lower = smooth((places_mm(window)[1] - 126) / 5)[None, None]
    lip_melanin = base * (1.15 - 0.45 * lower) + 0.006 + 0.004 * lines
    lip_blood = (3.2 + 0.5 * lower) * (0.012 + 0.6 * each(people.haemoglobin)) * (1 + 0.10 * lines)
    return melanin + lips * (lip_melanin - melanin), blood + lips * (lip_blood - blood)


def _around_eyes(window: Window) -> Tensor:
    """Return the mask [1, 1, T, T] of the lids and the hollows under them."""
    near = smooth((inside(window, "eyes") + 13) / 13)
    under = blobs(window, 0.375, 0.385, 16, 0.5)
    return (0.7 * near + 0.6 * under).clamp(0, 1)


def _spots(
    people: People, window: Window, middle: Tensor, fine: Tensor, age: Tensor, generator: torch.Generator
) -> Tensor:
    """Draw the additional melanin [B, 1, T, T] of freckles, age spots and moles."""
    count = len(people.melanin)
    if bool((people.freckles > 0).any()):
        dots = noise(count, window, 1.8, generator, octaves=1)
        where = 0.5 + blobs(window, 0.35, 0.46, 30) + blob(window, 29, 22)
        freckles = smooth((dots + 0.35 * middle + 0.6 * (where.clamp(0, 1.4) - 1.4) - 0.7) / 1.6)
        spots = each(people.freckles) * 0.035 * freckles
    else:
        spots = torch.zeros_like(middle)
    patches = noise(count, window, 4.5, generator, octaves=1)
    spots = spots + 0.012 * age * smooth((patches - 1.9) / 1.2)
    x, y = places_mm(window)
    for face in range(count):
        for _ in range(int(people.moles[face])):
            place = torch.rand(5, generator=generator)
            at_x, at_y = 180 * float(place[0]) - 90, 230 * float(place[1]) - 20
            radius = 0.6 + 1.4 * float(place[2]) ** 3 + 0.5 * max(window.texel_mm)
            column, row = (int(c) for c in window.to_texels(torch.tensor([at_x, at_y])))
            reach = int(3 * radius / min(window.texel_mm)) + 2
            rows = slice(max(0, row - reach), max(0, row + reach))
            columns = slice(max(0, column - reach), max(0, column + reach))
            far2 = (x[rows, columns] - at_x) ** 2 + (y[rows, columns] - at_y) ** 2
            spots[face, 0, rows, columns] += (0.04 + 0.16 * place[3]) * torch.exp(
                -((far2 / radius**2) ** 1.5)
            )
    return spots


def _darkness(people: People) -> Tensor:
    """Return the darkness [B, 1, 1, 1] of people's hair relative to brown."""
    dark = (people.hair_eumelanin / 3).clamp(0.15, 1.6) * (1 - 0.6 * people.grey)
    return each(dark)


def _random_colours(
    count: int, window: Window, coarse: Tensor, middle: Tensor, generator: torch.Generator
) -> Tensor:
    """Draw random albedo [B, 3, T, T], so that a network does not rely on skin tones."""
    coloured = torch.cat([noise(count, window, 45, generator, octaves=2) for _ in range(3)], 1)
    mean = 0.15 + 0.4 * torch.rand(count, 3, 1, 1, generator=generator)
    return (mean * torch.exp(0.35 * coloured + 0.12 * middle + 0.1 * coarse)).clamp(0.02, 0.85)


def _make_up(albedo: Tensor, people: People, window: Window) -> Tensor:
    """Return the albedo [B, 3, T, T] with lipstick, eye shadow and eyeliner."""
    colour = torch.stack([people.lipstick_red, people.lipstick_green, people.lipstick_blue], -1)
    cover = 0.8 * each(people.lipstick) * mask(window, "lips", 1.6, -0.3)
    own = albedo.mean(1, keepdim=True) / albedo.mean((1, 2, 3), keepdim=True).clamp_min(0.02)
    albedo = albedo + cover * (colour[..., None, None] * own.clamp(0.5, 1.2) - albedo)
    lids = blobs(window, 0.355, 0.285, 17, 0.42) * (1 - mask(window, "brows", 4.0))
    shade = each(colour.mean(-1)) * torch.tensor([0.55, 0.42, 0.45]).view(1, 3, 1, 1)
    cover = 0.8 * each(people.eye_shadow) * lids.clamp(0, 1)
    albedo = albedo + cover * (shade - albedo)
    beyond = inside(window, "eyes")
    line = smooth((beyond + 1.7) / 0.9) * smooth((0.8 - beyond) / 0.9)
    return albedo * (1 - 0.8 * each(people.eyeliner) * line)


def _with_hair(albedo: Tensor, people: People, hair: FacialHair, fine: Tensor, middle: Tensor) -> Tensor:
    """Return the albedo with brows and beard; brows turn grey later than other hair."""
    streaks = (1 + 0.25 * fine + 0.12 * middle).clamp(0.3, 1.8)
    beard_grey, brow_grey = 0.7 * people.grey**1.5, 0.45 * (people.grey - 0.5).clamp_min(0)
    for cover, melanin, grey in ((hair.beard, 0.8, beard_grey), (hair.brows, 1.3, brow_grey)):
        colour = hair_albedo(people.hair_eumelanin * melanin, people.hair_pheomelanin, grey)
        albedo = albedo + cover * (colour[..., None, None] * streaks - albedo)
    return albedo


def _openings(albedo: Tensor, window: Window) -> Tensor:
    """Return the albedo with dark nostrils and a dark line between the lips."""
    nostrils = mask(window, "nostrils", 2.5)
    slit = mask(window, "mouth", 1.2, 0.5)
    dark = torch.tensor([0.80, 0.93, 0.93]).view(1, 3, 1, 1)
    return albedo * (1 - 0.9 * nostrils * dark) * (1 - 0.45 * slit * dark)


def _lid_rims(albedo: Tensor, people: People, window: Window) -> Tensor:
    """Return the albedo with the wet pink rim of the lids and the roots of the lashes along their edge."""
    beyond = inside(window, "eyes")
    upper = smooth((62.5 - places_mm(window)[1]) / 5)[None, None]
    rim = smooth((beyond + 0.6) / 1.2)
    pink = skin_albedo(0.25 * each(people.melanin), 0.03 + 0 * each(people.melanin))
    albedo = albedo + 0.6 * rim * (pink - albedo)
    width = 0.7 + 0.6 * upper
    lashes = torch.exp(-(((beyond + 0.9) / width) ** 2)) * (0.22 + 0.48 * upper)
    return albedo * (1 - lashes * _darkness(people).clamp(0.5, 1))


def _gloss(
    people: People, window: Window, hair: Tensor, middle: Tensor, fine: Tensor, painted_eyes: bool
) -> tuple[Tensor, Tensor]:
    """Reflectance at normal incidence and roughness [B, 1, T, T]; they do not depend on the skin tone."""
    oil = each(people.oiliness)
    powder = each(people.foundation)
    t_zone = blob(window, 30, 15) + blob(window, 27, 20) + 0.8 * blob(window, (0.5, 0.06), 36, 0.7)
    t_zone = (t_zone + 0.5 * blobs(window, 0.31, 0.45, 17) + 0.4 * blob(window, 8, 14)).clamp(0, 1)
    lips = mask(window, "lips", 2.0)
    specular = 0.028 * (0.8 + 0.3 * oil + 0.3 * t_zone * oil + 0.08 * middle + 0.12 * fine)
    specular = specular * (1 - 0.2 * powder) + lips * 0.007
    specular = specular * (1 - 0.5 * hair) * (1 - 0.85 * mask(window, "nostrils", 2.5))
    roughness = 0.62 - 0.07 * oil - 0.10 * t_zone * (0.2 + 0.8 * oil) + 0.06 * powder + 0.03 * middle
    roughness = roughness + 0.03 * fine + lips * (0.44 + 0.03 * fine - roughness)
    roughness = roughness + 0.15 * hair
    if painted_eyes:
        eyes = mask(window, "eyes", 1.0)
        specular, roughness = specular + eyes * (0.03 - specular), roughness + eyes * (0.18 - roughness)
    return specular.clamp(0.003, 0.08), roughness.clamp(0.16, 0.85)
