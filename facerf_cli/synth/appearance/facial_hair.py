"""Hair painted on the skin: brows and beards of single strokes, stubble, short hair on the scalp."""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import torch
from torch import Tensor

from facerf_cli.face.topology import UV_SIZE_MM
from facerf_cli.synth import tables_of
from facerf_cli.synth.appearance.people import People, each
from facerf_cli.synth.random_fields import (
    LANDMARK_MM,
    Strokes,
    Window,
    blob,
    hairs,
    mask,
    noise,
    places_mm,
    smooth,
    splat,
)

_TABLES = tables_of(__file__)
_BROW_HAIRS = 420  # per brow
_BEARD_HAIRS_MM2 = 0.6  # per square millimetre


@dataclass(frozen=True)
class FacialHair:
    """Cover by hair [B, 1, T, T] in 0..1; shadow: absorbance of shaved hair below the surface."""

    brows: Tensor
    beard: Tensor
    shadow: Tensor

    @property
    def cover(self) -> Tensor:
        """Coverage by brows and beard together."""
        return 1 - (1 - self.brows) * (1 - self.beard)


def draw_facial_hair(people: People, window: Window, generator: torch.Generator) -> FacialHair:
    brows = _brows(people, window, generator)
    beard, shadow = _beards(people, window, generator)
    return FacialHair(brows, beard, shadow)


def _coarseness(window: Window) -> float:
    """Return how many hairs one stroke draws, because texels are too large to separate them."""
    return max(1.0, min(window.texel_mm) / 0.6)


def _brows(people: People, window: Window, generator: torch.Generator) -> Tensor:
    """Draw the cover [B, 1, T, T] by the single hairs of the brows."""
    merged = _coarseness(window)
    number = (_BROW_HAIRS * people.brow_fullness / merged).long()
    sides = torch.stack([number, number], -1).view(-1)  # for every face the right brow, then the left one
    owner = torch.repeat_interleave(torch.arange(len(sides)), sides)
    face, mirrored = owner // 2, (owner % 2).bool()
    count = len(owner)
    fullness = people.brow_fullness[face]

    def normal() -> Tensor:
        return torch.randn(count, generator=generator)

    along = torch.rand(count, generator=generator) ** 0.9 * 1.02 - 0.01
    across = 1.8 * torch.rand(count, generator=generator) - 0.9
    across = across + 0.25 * normal() * (1 - across.abs())
    middle, outward_deg = _brow_line(along)
    half = _lookup("brow_half_mm", along) * (0.75 + 0.35 * fullness)
    rise = torch.deg2rad(_lookup("brow_rise_deg", along) + 26 * across + 9 * normal() + outward_deg)
    bend = torch.deg2rad(-18 - 16 * normal().abs()) * (1 - along)
    length = _lookup("brow_length_mm", along) * (0.75 + 0.4 * torch.rand(count, generator=generator))
    roots = middle + torch.stack([torch.zeros(count), across * half], -1)
    # A hair starts behind its place, so that it is centred there.
    roots = roots - 0.35 * length[:, None] * torch.stack([rise.cos(), -rise.sin()], -1)
    roots = torch.where(mirrored[:, None], roots * torch.tensor([-1.0, 1.0]), roots)
    rise, bend = torch.where(mirrored, torch.pi - rise, rise), torch.where(mirrored, -bend, bend)
    strokes = Strokes(roots, rise, bend, length, merged * (0.13 + 0.05 * fullness))
    return 1 - torch.exp(-2.2 * hairs(window, strokes, face, len(people.age)))


def _brow_line(along: Tensor) -> tuple[Tensor, Tensor]:
    """Return points [N, 2] along the right brow, from 0 (inner end) to 1, and its slope there in degrees."""
    points = torch.from_numpy(LANDMARK_MM[22:27]).float() + torch.tensor([0.0, 1.8])
    at = along.clamp(0, 1) * 4
    low = at.floor().clamp(max=3).long()
    step = points[low + 1] - points[low]
    smooth_step = (points[(low + 2).clamp(max=4)] - points[(low - 1).clamp(min=0)]) / 3
    return points[low] + (at - low)[:, None] * step, torch.rad2deg(
        torch.atan2(-smooth_step[:, 1], smooth_step[:, 0])
    )


def _lookup(table: str, at: Tensor) -> Tensor:
    """Interpolate a table at positions [N] in 0..1."""
    values = _TABLES[table]
    sampled = np.interp(at.numpy(), np.linspace(0, 1, len(values)), values)
    return torch.from_numpy(sampled).float()


def _below_edge(window: Window, edge: str, shift_mm: Tensor | float = 0) -> Tensor:
    """Return the distance [1 or B, 1, T, T] in millimetres below an edge that is symmetric."""
    x, y = places_mm(window)
    out = (x.abs() / float(UV_SIZE_MM[0])).clamp(max=1)
    u, v = np.array(_TABLES[edge]).T
    edge_mm = torch.from_numpy(np.interp(out.numpy(), u, v) * UV_SIZE_MM[1]).float()
    return (y - edge_mm)[None, None] - shift_mm


@lru_cache(maxsize=4)  # all people share it
def beard_density(window: Window) -> Tensor:
    """Return the density [1, 1, T, T] of a beard, about 0..1: thin toward the cheeks and on the neck."""
    x, y = places_mm(window)
    lower = smooth(_below_edge(window, "beard_edge") / 20 + 0.5)
    neck = smooth((186 - y) / 36)[None, None]
    moustache = smooth((36 - x.abs()) / 12) * smooth((y - 104) / 8) * smooth((134 - y) / 10)
    chin = 0.6 * blob(window, 8, 16) + 0.8 * blob(window, (0.5, 0.83), 8, 0.8)
    ground = (torch.maximum(lower * neck, moustache[None, None]) + 0.3 * chin).clamp(0, 1.1)
    ground = ground * (1 - 0.7 * blob(window, (0.5, 0.645), 2.5, 2))  # the groove under the nose
    return ground * (1 - mask(window, "lips", 5.0, 2.0))


def _beards(people: People, window: Window, generator: torch.Generator) -> tuple[Tensor, Tensor]:
    """Draw cover and shadow [B, 1, T, T]: stubble in the whole beard area, longer hair where it is uncut."""
    count = len(people.age)
    cover, shadow = (torch.zeros(count, 1, window.side, window.side) for _ in "ab")
    grown = (people.stubble_mm > 0).nonzero()[:, 0].tolist()
    if not grown:
        return cover, shadow
    patchy = 1 + 0.25 * noise(len(grown), window, 18, generator, octaves=2)
    ground = beard_density(window)
    for index, patch in zip(grown, patchy, strict=True):
        density = ground * patch[None].clamp(0.3, 1.4)
        cover[index], shadow[index] = _beard(people, index, window, density, generator)
    return cover, shadow


def _beard(
    people: People, index: int, window: Window, ground: Tensor, generator: torch.Generator
) -> tuple[Tensor, Tensor]:
    """Draw cover and shadow [1, 1, T, T] of one person."""
    stubble = float(people.stubble_mm[index])
    x, y = places_mm(window)
    goatee = smooth((38 - x.abs()) / 10)[None, None]
    moustache = (smooth((34 - x.abs()) / 6) * smooth((130 - y) / 6) * (y > 100))[None, None]
    beard = float(people.beard[index]) * (goatee if people.goatee[index] > 0 else 1) * (1 - moustache)
    left = (beard * smooth((176 - y) / 16) + float(people.moustache[index]) * moustache) * ground
    layers = _rooted(ground, window, 0.12, stubble, generator)
    if float(left.max()) > 0.02:
        layers = layers + _rooted(left, window, 0.30, 8.0, generator) + 0.5 * left
    return 1 - torch.exp(-layers), ground * (0.10 + 0.12 * min(stubble, 1.0))


def _rooted(
    density: Tensor, window: Window, width_mm: float, length_mm: float, generator: torch.Generator
) -> Tensor:
    """Draw layers of hairs that grow down and slightly outward, with a density [1, 1, T, T]."""
    wide, high = 75.0, 115.0  # half width and height of the area in millimetres
    merged = _coarseness(window) ** 1.5
    number = int(_BEARD_HAIRS_MM2 * 2 * wide * high / merged)
    roots = torch.rand(number, 2, generator=generator) * torch.tensor([2 * wide, high])
    roots = roots + torch.tensor([-wide, 85.0])
    at = window.to_texels(roots).round().long()
    within = ((at >= 0) & (at < window.side)).all(-1)
    at = at.clamp(0, window.side - 1)
    kept = within & (torch.rand(number, generator=generator) < density[0, 0, at[:, 1], at[:, 0]])
    jitter = torch.randn(number, 2, generator=generator)
    roots, jitter = roots[kept], jitter[kept]
    if length_mm < 1.5 * min(window.texel_mm):  # a hair is a dot
        area = torch.full((len(roots),), merged * width_mm * max(length_mm, width_mm))
        return splat(window, roots, area * (1 + 0.4 * jitter[:, 0]).clamp_min(0.2))
    down = -torch.pi / 2 + 0.008 * roots[:, 0] + 0.25 * jitter[:, 0]
    lengths = length_mm * (1 + 0.25 * jitter[:, 1]).clamp(0.4, 1.8)
    widths = torch.full((len(roots),), merged * width_mm)
    return hairs(window, Strokes(roots, down, 0.4 * jitter[:, 1], lengths, widths))


def scalp_hair(people: People, window: Window, above_mm: Tensor, generator: torch.Generator) -> Tensor:
    """Draw the cover [B, 1, T, T] by short hair on the scalp; above_mm [B, 1, T, T]: `above_hairline`."""
    count = len(people.age)
    ragged = 3.0 * noise(count, window, 14, generator, octaves=3)
    strands = noise(count, window, (1.2, 6), generator, octaves=1)
    return (smooth((above_mm + ragged + 3) / 12) * (0.9 + 0.07 * strands)).clamp(0, 0.97)


def above_hairline(people: People, window: Window) -> Tensor:
    """Return the distance [B, 1, T, T] in millimetres above each person's hairline."""
    return -_below_edge(window, "scalp_edge", each(people.hairline_mm))
