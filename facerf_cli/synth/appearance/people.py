"""Physical parameters of synthetic people, drawn at random."""

from dataclasses import dataclass, fields

import torch
from torch import Tensor

from facerf_cli.synth.random_fields import Uniform

DARKEST, LIGHTEST = 0.23, 0.0075  # melanin fractions of the darkest and of the lightest skin
RANDOM_TEXTURES = 0.06  # fraction of people with random colours instead of skin tones


@dataclass(frozen=True)
class People:
    """Parameters [B] of B people; fractions and strengths in 0..1 unless stated otherwise.

    melanin is the fraction of the epidermis's volume that is melanosomes, and haemoglobin the fraction of the
    dermis's volume that is blood, as in `pigments`. The melanins of hair have the units of `hair_albedo`.
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
    foundation: Tensor  # strength by which it evens out the skin
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
    """The parameters of one person by name, rounded, for a record."""
    return {field.name: round(float(getattr(people, field.name)[index]), 4) for field in fields(people)}


def each(values: Tensor) -> Tensor:
    """A parameter [B] as [B, 1, 1, 1], to combine with textures [B, C, T, T]."""
    return values.view(-1, 1, 1, 1)
