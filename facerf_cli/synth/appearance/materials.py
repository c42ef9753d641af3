"""Materials of the parts of a synthetic head: skin, eyes, mouth, teeth, cloth, hair and frames of glasses."""

from dataclasses import dataclass, replace

import torch
import torch.nn.functional as F
from torch import Tensor

from facerf_cli.image.colour import ita_deg
from facerf_cli.raster.texture import texel_centres_uv
from facerf_cli.synth import tables_of
from facerf_cli.synth.appearance.people import (
    People,
    draw_people,
    eyeball_textures,
    hair_albedo,
    parameters_of,
)
from facerf_cli.synth.appearance.skin import bare_skin, paint_skin, scattering_mm, with_scalp
from facerf_cli.synth.head.mesh import PARTS
from facerf_cli.synth.random_fields import CANVAS_SPAN, Uniform, Window, plain_noise
from facerf_cli.synth.shading import Material

_SIDE = 256  # of the textures of eyes and cloth
_CLOTHS = ("plain", "plain", "plain", "heather", "stripes", "check")
_DYES = tables_of(__file__)["dyes"]  # of garments, linear Rec.709
_HAIR_WISPS = 512  # different wisps in the texture of hair
_PAINTED_HAIR = ("bald", "hairline_mm")  # parameters of painted scalp hair; here hair is geometry


@dataclass(frozen=True)
class Appearance:
    """Materials by name of the part, and the traits of the person.

    The texture of the skin covers the canvas: the UV map of the face widened to `CANVAS_SPAN`. scattering_mm
    [3]: sigma of the Gaussian that spreads each channel's light under the skin.
    """

    materials: dict[str, Material]
    scattering_mm: Tensor
    traits: dict[str, float | str | bool]


def draw_appearance(side: int, generator: torch.Generator) -> Appearance:
    """Draw one person with clothes and glasses; `side` of the canvas only sets the resolution of the skin."""
    people = replace(draw_people(1, generator), random_texture=torch.zeros(1))
    eye, eye_traits = eyeball_textures(_SIDE, people, generator)
    frame, frame_kind = _frame(generator)
    cloth, cloth_kind = _cloth(generator)
    materials = {
        "eye": eye,
        "mouth": _mouth(generator),
        "teeth": _teeth(people, generator),
        "cloth": cloth,
        "hair": _hair(people, generator),
        "frame": frame,
        "hat": _cloth(generator)[0],
        "skin": paint_skin(people, Window(side, CANVAS_SPAN), generator, painted_eyes=False).part(0),
    }
    traits = parameters_of(people, 0)
    for name in _PAINTED_HAIR:
        del traits[name]
    traits["random_texture"] = bool(people.random_texture[0])
    traits["ita_deg"] = round(float(ita_deg(bare_skin(people)[0].double().numpy())), 1)
    traits["hair_colour"] = _hair_name(people)
    traits.update(eye_traits, frame=frame_kind, cloth=cloth_kind)
    return Appearance(materials, scattering_mm(people)[0], traits)


def canvas_uv(side: int) -> Tensor:
    """(u, v) [T, T, 2] at the centres of the canvas's texels."""
    return CANVAS_SPAN[0] + (CANVAS_SPAN[1] - CANVAS_SPAN[0]) * texel_centres_uv(side)


def with_short_hair(appearance: Appearance, cover: Tensor, generator: torch.Generator) -> Appearance:
    """Return the person with short hair painted on the scalp, with coverage [T, T] on the canvas.

    Its colour is the mean of the hair's roots.
    """
    colour = appearance.materials["hair"].albedo[:, :8].mean((1, 2)).view(3, 1, 1)
    skin = with_scalp(appearance.materials["skin"], 0.9 * cover.float()[None], colour, generator)
    return replace(appearance, materials=appearance.materials | {"skin": skin})


def sample(appearance: Appearance, part: Tensor, uv: Tensor) -> Material:
    """Sample the materials at points, bilinear; cloth is repeated in mirror image, the others are clamped.

    part [N] is an index into `mesh.PARTS`, uv [N, 2] as in `HeadMesh`.
    """
    values = torch.zeros(len(uv), 7)
    for index in sorted(set(part.tolist())):
        name = PARTS[index]
        chosen = (part == index).nonzero()[:, 0]
        at = uv[chosen].float()
        if name == "skin":
            at = (at - CANVAS_SPAN[0]) / (CANVAS_SPAN[1] - CANVAS_SPAN[0])
        material = appearance.materials[name]
        texture = torch.cat([material.albedo, material.specular, material.roughness, material.relief])
        grid = (2 * at - 1).view(1, 1, -1, 2)
        beyond = "reflection" if name in ("cloth", "hat") else "border"
        sampled = F.grid_sample(texture[None], grid, padding_mode=beyond, align_corners=False)
        values[chosen] = sampled[0, :, 0].T
    return Material(values[:, :3], values[:, 3], values[:, 4], values[:, 5:])


def _flat(albedo: Tensor, specular: float, roughness: float, relief: Tensor | None = None) -> Material:
    one = torch.ones(1, *albedo.shape[1:])
    return Material(
        albedo.clamp(0.003, 0.95),
        specular * one,
        roughness * one,
        torch.zeros(2, *albedo.shape[1:]) if relief is None else relief,
    )


def _uniform(low: float, high: float, generator: torch.Generator) -> float:
    return float(Uniform(generator)(low, high))


def _mouth(generator: torch.Generator) -> Material:
    """Draw wet gums and tongue."""
    colour = torch.tensor([0.30, 0.075, 0.065]) * _uniform(0.5, 1.1, generator)
    patches = plain_noise((64, 64), 10, generator)
    return _flat(colour.view(3, 1, 1) * (1 + 0.15 * patches), 0.03, 0.3)


def _teeth(people: People, generator: torch.Generator) -> Material:
    """Draw enamel, yellower with age."""
    yellow = 0.35 + 0.65 * float(people.age[0] - 18) / 57 * _uniform(0.3, 1, generator)
    white, old = torch.tensor([0.60, 0.57, 0.52]), torch.tensor([0.50, 0.43, 0.31])
    colour = (white + yellow * (old - white)) * _uniform(0.8, 1.1, generator)
    return _flat(colour.view(3, 1, 1) * (1 + 0.06 * plain_noise((64, 64), 12, generator)), 0.045, 0.25)


def _cloth(generator: torch.Generator) -> tuple[Material, str]:
    """Draw plain, heathered, striped or checked cloth, and its kind."""
    kind = _CLOTHS[int(torch.randint(len(_CLOTHS), (), generator=generator))]
    side = _SIDE
    weave = torch.randn(1, side, side, generator=generator)
    albedo = _dye(generator) * (1 + 0.06 * weave)
    if kind == "heather":
        albedo = albedo * (1 + 0.12 * weave)
    if kind in ("stripes", "check"):
        phase = torch.arange(side).view(1, -1, 1) / side * round(_uniform(8, 24, generator))
        stripe = torch.sigmoid(12 * (torch.sin(2 * torch.pi * phase) - _uniform(-0.6, 0.6, generator)))
        if kind == "check":
            stripe = (stripe + stripe.transpose(1, 2)) / 2
        albedo = albedo * (1 - stripe) + stripe * _dye(generator) * (1 + 0.06 * weave)
    relief = 0.12 * torch.randn(2, side, side, generator=generator)
    return _flat(albedo, 0.02, _uniform(0.7, 0.9, generator), relief), kind


def _dye(generator: torch.Generator) -> Tensor:
    """Draw the colour [3, 1, 1] of a garment near one of `_DYES`."""
    colour = torch.tensor(_DYES[int(torch.randint(len(_DYES), (), generator=generator))])
    shift = torch.exp(
        0.15 * torch.randn((), generator=generator) + 0.06 * torch.randn(3, generator=generator)
    )
    return (colour * shift).clamp(0.012, 0.8).view(3, 1, 1)


def _hair(people: People, generator: torch.Generator) -> Material:
    """Draw slightly different wisps along u; along v, from root to tip, they become lighter."""
    wisps = _HAIR_WISPS
    melanin = torch.exp(0.18 * torch.randn(wisps, generator=generator))
    grey = people.grey[0]
    mixed = 0.3 * (grey * (1 - grey)).sqrt()  # a wisp is of many hairs, white ones among them
    white = (grey + mixed * torch.randn(wisps, generator=generator)).clamp(0, 1)
    tip = torch.linspace(1.1, _uniform(0.55, 1.0, generator), 64)[:, None]
    eumelanin = people.hair_eumelanin[0] * melanin * tip
    albedo = hair_albedo(eumelanin, people.hair_pheomelanin[0] * melanin * tip, white.expand(64, -1))
    strands = 1 + 0.1 * torch.randn(64, wisps, generator=generator)
    return _flat(albedo.permute(2, 0, 1) * strands, 0.046, _uniform(0.35, 0.5, generator))


def _hair_name(people: People) -> str:
    eumelanin, pheomelanin = float(people.hair_eumelanin[0]), float(people.hair_pheomelanin[0])
    if people.grey[0] > 0.5:
        return "grey"
    if pheomelanin > 0.7 and eumelanin < 3:
        return "red"
    names = ((0.8, "blond"), (2.0, "light brown"), (4.0, "brown"))
    return next((name for most, name in names if eumelanin < most), "black")


def _frame(generator: torch.Generator) -> tuple[Material, str]:
    """Draw a frame of glasses (metal, acetate of one colour, or tortoiseshell), and its kind."""
    kind = ("metal", "acetate", "acetate", "tortoise")[int(torch.randint(4, (), generator=generator))]
    flat = torch.ones(3, 64, 64)
    if kind == "metal":
        tint = torch.tensor([[0.55, 0.55, 0.56], [0.60, 0.46, 0.24], [0.10, 0.10, 0.11]])
        shine = tint[int(torch.randint(3, (), generator=generator))]
        return _flat(flat * shine.view(3, 1, 1) * 0.25, float(shine.mean()), 0.3), kind
    if kind == "tortoise":
        spots = torch.sigmoid(4 * plain_noise((64, 64), 10, generator))
        dark, amber = torch.tensor([0.02, 0.010, 0.006]), torch.tensor([0.28, 0.11, 0.025])
        return _flat(dark.view(3, 1, 1) + spots * (amber - dark).view(3, 1, 1), 0.04, 0.15), kind
    colour = torch.exp(torch.randn(3, generator=generator) * 0.8 - 3.2).clamp(0.01, 0.5)
    return _flat(flat * colour.view(3, 1, 1), 0.04, 0.15), kind
