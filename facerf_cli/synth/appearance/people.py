"""Traits of random people; the colours that pigments give hair; and eyes."""

import math
from dataclasses import dataclass, fields

import torch
from torch import Tensor

from facerf_cli.raster.texture import texel_centres_uv
from facerf_cli.synth import tables_of
from facerf_cli.synth.random_fields import LANDMARK_MM, Uniform, Window, mask, places_mm, plain_noise
from facerf_cli.synth.shading import Material

DARKEST, LIGHTEST = 0.23, 0.0075  # melanin fractions of the darkest and of the lightest skin
RANDOM_TEXTURES = 0.06  # fraction of people with random colours instead of skin tones
_TABLES = tables_of(__file__)
_CORNERS = ((36, 39), (42, 45))  # landmarks of the eyes' corners
IRIS_DEG = 29.0  # edge of the iris, from the gaze axis
_RADIUS_MM = 12.0  # of the eyeball
_IRISES: dict[str, list[float]] = _TABLES["irises"]  # colours, linear Rec.709
_FAIR_SHARES = (0.35, 0.15, 0.15, 0.25, 0.10)  # frequency among fair people; all others are brown


@dataclass(frozen=True)
class People:
    """Parameters [B] of B people; fractions and strengths in 0..1 unless stated otherwise.

    melanin is the fraction of the epidermis's volume that is melanosomes, and haemoglobin the fraction of the
    dermis's volume that is blood, as in `image/skin.py`. The melanins of hair
    have the units of `hair_albedo`.
    """

    melanin: Tensor
    haemoglobin: Tensor
    oiliness: Tensor
    age: Tensor  # years
    blotches: Tensor
    flush: Tensor  # of cheeks and nose
    freckles: Tensor  # 0 for most
    moles: Tensor  # count
    hair_eumelanin: Tensor
    hair_pheomelanin: Tensor
    grey: Tensor  # share of white hair
    brow_fullness: Tensor
    stubble_mm: Tensor  # hair left on the lower face; 0 where none grows
    beard: Tensor  # cover of the beard's area by hair; 0 where none grows
    moustache: Tensor
    goatee: Tensor  # 1 where the beard leaves the cheeks free
    bald: Tensor  # 0 or 1
    hairline_mm: Tensor  # distance below the usual hairline
    lipstick: Tensor  # cover
    lipstick_red: Tensor  # its colour, linear Rec.709
    lipstick_green: Tensor
    lipstick_blue: Tensor
    eye_shadow: Tensor  # cover
    eyeliner: Tensor
    foundation: Tensor  # how strongly it evens out the skin
    random_texture: Tensor  # 0 or 1


def draw_people(count: int, generator: torch.Generator) -> People:
    """Draw people: skin evenly from very light to dark, the other traits as common as in reality."""
    uniform = Uniform(generator, (count,))

    def share(part: float) -> Tensor:
        """1 for a random part of the people, 0 for the others."""
        return (torch.rand(count, generator=generator) < part).float()

    tone = uniform(0, 1)
    melanin = LIGHTEST * (DARKEST / LIGHTEST) ** tone
    age = 18 + 57 * uniform(0, 1) ** 1.6
    fair = (0.62 - tone).clamp(0, 1) / 0.62 * share(0.75)  # only the fair-skinned have fair hair
    red = share(0.06) * (tone < 0.4)
    grey = ((age - 45 + uniform(-12, 12)) / 35).clamp(0, 1) ** 1.3
    bearded = share(0.5)
    style = uniform(0, 1)
    full, moustached, chin = style < 0.2, (style > 0.2) & (style < 0.27), (style > 0.27) & (style < 0.36)
    made_up = (1 - bearded) * share(0.55)
    deep = uniform(0, 1)
    return People(
        melanin=melanin,
        haemoglobin=uniform(0.006, 0.020),
        oiliness=uniform(0, 1),
        age=age,
        blotches=uniform(0.2, 1),
        flush=uniform(0.1, 1),
        freckles=share(0.18) * uniform(0.2, 1) * (tone < 0.65),
        moles=(uniform(0, 1) ** 2 * 14).floor(),
        hair_eumelanin=torch.exp(uniform(0.8, 2.1) - fair * uniform(0, 2.6)) * (1 - 0.7 * red),
        hair_pheomelanin=uniform(0, 0.4) + red * uniform(0.8, 1.6),
        grey=grey,
        brow_fullness=uniform(0.35, 1) * (0.8 + 0.2 * bearded),
        stubble_mm=bearded * uniform(0.05, 1) ** 2 * 3,
        beard=bearded * (full | chin) * uniform(0.3, 1),
        moustache=bearded * (full | moustached | chin) * uniform(0.3, 1),
        goatee=bearded * chin,
        bald=bearded * share(0.15),
        hairline_mm=uniform(-14, 10) - 10 * bearded * ((age - 40) / 35).clamp(0, 1),
        lipstick=made_up * uniform(0.2, 0.9),
        lipstick_red=0.12 + 0.38 * (1 - deep),
        lipstick_green=0.02 + 0.16 * (1 - deep) * uniform(0.3, 1),
        lipstick_blue=0.025 + 0.16 * (1 - deep) * uniform(0.3, 1.1),
        eye_shadow=made_up * share(0.5) * uniform(0.1, 0.6),
        eyeliner=made_up * share(0.6) * uniform(0.3, 0.9),
        foundation=made_up * uniform(0.2, 0.8),
        random_texture=share(RANDOM_TEXTURES),
    )


def parameters_of(people: People, index: int) -> dict[str, float | str | bool]:
    """Return the parameters of one person by name, rounded, for a record."""
    return {field.name: round(float(getattr(people, field.name)[index]), 4) for field in fields(people)}


def each(values: Tensor) -> Tensor:
    """Return a parameter [B] as [B, 1, 1, 1], to combine with textures [B, C, T, T]."""
    return values.view(-1, 1, 1, 1)


def hair_albedo(eumelanin: Tensor, pheomelanin: Tensor, grey: Tensor) -> Tensor:
    """Return linear Rec.709 colours [..., 3] of dense hair from melanins [...] in the units of d'Eon et al.

    Absorption after d'Eon et al. (*An energy-conserving hair reflectance model*, 2011), colour of many fibres
    after Chiang et al. (*A practical and controllable hair and fur model*, 2016), plus a small reflection at
    the cuticles. Eumelanin 0.3 is blond, 1.3 brown, 8 black; grey in 0..1 is the fraction of white hair.
    """
    absorbed = eumelanin[..., None] * torch.tensor([0.419, 0.697, 1.37])
    absorbed = absorbed + pheomelanin[..., None] * torch.tensor([0.187, 0.4, 1.05])
    pigmented = torch.exp(-5.89 * absorbed.sqrt()) + torch.tensor([0.011, 0.0095, 0.0085])
    white = torch.tensor([0.44, 0.41, 0.36])
    return pigmented + grey[..., None] * (white - pigmented)


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
) -> tuple[Material, dict[str, float | str | bool]]:
    """Draw the textures of the first person's eyes, and their traits.

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
    return Material(albedo.clamp(0.003, 0.9), 0.03 * wet, roughness, relief), traits


def _sclera(side: int, angle: Tensor, redness: float, age: float, generator: torch.Generator) -> Tensor:
    """Return the albedo [3, T, T] of the sclera: yellower with age, with more pink and veins off the iris."""
    young, old = torch.tensor([0.50, 0.46, 0.44]), torch.tensor([0.47, 0.41, 0.33])
    base = (young + (old - young) * (age - 18) / 57 * 0.8).view(3, 1, 1)
    ridges = 1 - plain_noise((side, side), 26, generator).abs() * 3
    veins = ridges.clamp(0, 1) ** 3 * torch.sigmoid((angle - 45) / 7)
    pink = (0.10 + 0.35 * redness) * torch.sigmoid((angle - 58) / 9) + (0.25 + 0.5 * redness) * veins
    return base * (1 - pink * torch.tensor([0.12, 0.75, 0.70]).view(3, 1, 1))


def _iris(
    angle: Tensor, turn: Tensor, pupil_deg: float, colour: Tensor, generator: torch.Generator
) -> Tensor:
    """Return the albedo [3, T, T] of iris and pupil: radial fibres, a collarette and a limbal ring."""
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
    """Return the face's albedo [B, 3, T, T] with eyes painted between the lids; both have one gaze."""
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
