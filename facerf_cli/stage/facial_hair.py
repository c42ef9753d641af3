"""Hair that is painted on the skin: brows and beards of single strokes, stubble, the scalp's cover."""

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from facerf_cli.face.regions import CHART_MM
from facerf_cli.stage.noise import blurred, hairs, noise, splat
from facerf_cli.stage.people import People
from facerf_cli.stage.window import LANDMARK_MM, Window, blob, mask, places_mm, smooth

# Of the brow from its inner to its outer end: half its height in millimetres, where the hairs point (degrees
# above the way outward), how long they are.
_BROW_HALF_MM = (3.3, 4.2, 3.7, 2.6, 1.1)
_BROW_RISE_DEG = (74, 48, 26, 10, -6)
_BROW_LENGTH_MM = (5.0, 7.5, 8.5, 8.0, 6.0)
_BROW_HAIRS = 420
_BEARD_HAIRS, _SHORT_HAIRS = 9000, 9000
_BEARD_MM2 = 24000.0  # rough area of a full beard's ground
# Upper edge of the beard and of the scalp's hair: (u, v), u from the midline outward.
_BEARD_EDGE = """
0 0.80 | 0.05 0.80 | 0.075 0.755 | 0.11 0.72 | 0.14 0.68 | 0.20 0.665 | 0.30 0.60 | 0.38 0.49 | 0.43 0.40 |
0.47 0.33 | 0.55 0.36 | 0.62 1.2 | 1.0 1.3
"""
_SCALP_EDGE = """
0 -0.10 | 0.15 -0.105 | 0.25 -0.09 | 0.32 -0.035 | 0.38 0.03 | 0.43 0.15 | 0.47 0.32 | 0.52 0.36 | 0.57 0.30 |
0.63 0.16 | 0.75 0.17 | 0.86 0.40 | 0.95 0.72 | 1.0 0.82
"""


@dataclass(frozen=True)
class FacialHair:
    """Cover by hair [B, 1, T, T] in 0..1, and the shadow of what is cut below the surface, as absorbance."""

    brows: Tensor
    beard: Tensor
    scalp: Tensor
    shadow: Tensor

    @property
    def cover(self) -> Tensor:
        """All hair together."""
        return 1 - (1 - self.brows) * (1 - self.beard) * (1 - self.scalp)


def draw_facial_hair(people: People, window: Window, generator: torch.Generator) -> FacialHair:
    """Hair of every person."""
    count = len(people.melanin)
    brows = torch.cat([_brows(float(full), window, generator) for full in people.brow_fullness])
    ground = beard_ground(window)
    patchy = 1 + 0.25 * noise(count, window, 18, generator, octaves=2)
    beard, shadow = [], []
    for i in range(count):
        grown, below = _beard(people, i, window, ground * patchy[i : i + 1].clamp(0.2, 1.5), generator)
        beard.append(grown)
        shadow.append(below)
    return FacialHair(brows, torch.cat(beard), _scalp(people, window, generator), torch.cat(shadow))


def _brows(fullness: float, window: Window, generator: torch.Generator) -> Tensor:
    layers = torch.zeros(1, 1, window.side, window.side)
    count = int(_BROW_HAIRS * fullness)
    width_mm = 0.11 + 0.05 * fullness
    for side in (-1, 1):
        along = torch.rand(count, generator=generator) ** 0.9 * 1.02 - 0.01
        across = (2 * torch.rand(count, generator=generator) - 1) * 0.9
        across = across + 0.25 * torch.randn(count, generator=generator) * (1 - across.abs())
        middle, outward = _brow_line(along)
        half = _lookup(_BROW_HALF_MM, along) * (0.8 + 0.3 * fullness)
        rise = _lookup(_BROW_RISE_DEG, along) + 26 * across + 9 * torch.randn(count, generator=generator)
        rise = torch.deg2rad(rise + outward)  # counter-clockwise from the picture's right, on the right side
        bend = torch.deg2rad(-18 - 16 * torch.randn(count, generator=generator).abs()) * (1 - along)
        length = _lookup(_BROW_LENGTH_MM, along) * (0.75 + 0.4 * torch.rand(count, generator=generator))
        roots = middle + torch.stack([torch.zeros(count), across * half], -1)
        # Hairs start behind their place, so that they are centred on it.
        roots = roots - 0.35 * length[:, None] * torch.stack([rise.cos(), -rise.sin()], -1)
        if side < 0:
            roots = roots * torch.tensor([-1.0, 1.0])
            rise, bend = torch.pi - rise, -bend
        layers += hairs(window, roots, rise, bend, length, width_mm)
    return 1 - torch.exp(-1.5 * layers)


def _brow_line(along: Tensor) -> tuple[Tensor, Tensor]:
    """Middle of the right-hand brow [N, 2] at 0 (inner) to 1 (outer end), and its rise there in degrees."""
    points = torch.from_numpy(LANDMARK_MM[22:27]).float() + torch.tensor([0.0, 1.8])
    at = along.clamp(0, 1) * 4
    low = at.floor().clamp(max=3).long()
    step = points[low + 1] - points[low]
    smooth_step = (points[(low + 2).clamp(max=4)] - points[(low - 1).clamp(min=0)]) / 3
    return points[low] + (at - low)[:, None] * step, torch.rad2deg(
        torch.atan2(-smooth_step[:, 1], smooth_step[:, 0])
    )


def _lookup(values: tuple[float, ...], at: Tensor) -> Tensor:
    found = np.interp(at.numpy(), np.linspace(0, 1, len(values)), values)
    return torch.from_numpy(found).float()


def below_edge(window: Window, edge: str, shift_mm: Tensor | float = 0) -> Tensor:
    """Millimetres [1 or B, 1, T, T] below an edge given from the midline outward, mirrored."""
    x, y = places_mm(window)
    out = (x.abs() / float(CHART_MM[0])).clamp(max=1)
    u, v = np.array(edge.replace("|", " ").split(), float).reshape(-1, 2).T
    edge_mm = torch.from_numpy(np.interp(out.numpy(), u, v) * CHART_MM[1]).float()
    return (y - edge_mm)[None, None] - shift_mm


def beard_ground(window: Window) -> Tensor:
    """Where a beard grows [1, 1, T, T]: 0..1."""
    x, y = places_mm(window)
    lower = smooth(below_edge(window, _BEARD_EDGE) / 9 + 0.5)
    neck = smooth((195 - y) / 25)[None, None]
    moustache = smooth((33 - x.abs()) / 9) * smooth((y - 105.5) / 4) * smooth((132 - y) / 8)
    chin = 0.6 * blob(window, 8, 16) + 0.8 * blob(window, (0.5, 0.83), 8, 0.8)
    ground = (torch.maximum(lower * neck, moustache[None, None]) + 0.3 * chin).clamp(0, 1.15)
    ground = ground * (1 - 0.75 * blob(window, (0.5, 0.66), 3.0, 2))  # the groove under the nose
    return ground * (1 - mask(window, "lips", 3.0, 1.0))


def _beard(
    people: People, index: int, window: Window, ground: Tensor, generator: torch.Generator
) -> tuple[Tensor, Tensor]:
    """Cover and shadow [1, 1, T, T] of one lower face: stubble everywhere it grows, hair where it is left."""
    nothing = torch.zeros(1, 1, window.side, window.side)
    stubble = float(people.stubble_mm[index])
    if stubble <= 0:
        return nothing, nothing
    x, y = places_mm(window)
    goatee = smooth((38 - x.abs()) / 10)[None, None]
    moustache = (smooth((34 - x.abs()) / 6) * smooth((130 - y) / 6) * (y > 100))[None, None]
    beard = float(people.beard[index]) * (goatee if people.goatee[index] > 0 else 1) * (1 - moustache)
    left = (beard + float(people.moustache[index]) * moustache) * ground
    layers = _rooted(ground, _SHORT_HAIRS, window, 0.12, stubble, generator)
    if float(left.max()) > 0.02:
        density = blurred(left, window, 1.0)
        layers = layers + _rooted(density, _BEARD_HAIRS, window, 0.28, 9.0, generator)
        layers = layers + 0.35 * density
    return 1 - torch.exp(-layers), ground * (0.16 + 0.10 * min(stubble, 1.0))


def _rooted(
    density: Tensor, count: int, window: Window, width_mm: float, length_mm: float, generator: torch.Generator
) -> Tensor:
    """Layers of hairs that grow down and a little outward, as dense as the field [1, 1, T, T] says."""
    wide, high = 75.0, 115.0  # millimetres from the midline; from cheeks to neck
    roots = torch.rand(count * 2, 2, generator=generator) * torch.tensor([2 * wide, high])
    roots = roots + torch.tensor([-wide, 85.0])
    at = window.to_texels(roots).round().long()
    seen = ((at >= 0) & (at < window.side)).all(-1)
    at = at.clamp(0, window.side - 1)
    kept = seen & (torch.rand(count * 2, generator=generator) < density[0, 0, at[:, 1], at[:, 0]])
    jitter = torch.randn(count * 2, 2, generator=generator)
    roots, jitter = roots[kept], jitter[kept]
    if length_mm < 1.5 * min(window.texel_mm):  # a dot
        area = torch.full((len(roots),), width_mm * max(length_mm, width_mm))
        return splat(window, roots, area * (1 + 0.4 * jitter[:, 0]).clamp_min(0.2))
    down = -torch.pi / 2 + 0.012 * roots[:, 0] + 0.28 * jitter[:, 0]
    lengths = length_mm * (1 + 0.25 * jitter[:, 1]).clamp(0.4, 1.8)
    return hairs(window, roots, down, 0.4 * jitter[:, 1], lengths, width_mm)


def _scalp(people: People, window: Window, generator: torch.Generator) -> Tensor:
    """Short hair on the scalp; on a bald one its shadow alone."""
    count = len(people.melanin)
    ragged = 3.0 * noise(count, window, 14, generator, octaves=3)
    above = -below_edge(window, _SCALP_EDGE, people.hairline_mm.view(-1, 1, 1, 1)) + ragged
    strands = noise(count, window, (1.2, 6), generator, octaves=2)
    cover = smooth((above + 4) / 14) * (0.9 + 0.08 * strands)
    return (cover * (1 - 0.8 * people.bald.view(-1, 1, 1, 1))).clamp(0, 0.98)
