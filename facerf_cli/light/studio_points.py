"""Studio lights as points: the squares of soft lights are sampled by a regular grid."""

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from facerf_cli.image.colour import REC709_CHROMATICITIES, colour_science, luminance, rgb_to_xyz
from facerf_cli.light.entries import StudioLight, parse_lights
from facerf_cli.light.sphere import azel_to_direction, rig_directions

_APART_DEG, _MOST_A_SIDE = 6.0, 6  # samples of a square, as seen from the face
_AROUND = 24  # samples of a light from all around
_NEAREST_M = 0.05  # distance below which a light does not grow any more
_FULL_CONE = 0.8  # share of a spot's cone in which it has its full strength; from there it falls to 0
_WIDEST_DEG = 36.0  # side of a light, as seen from the face, from which on its shadows have no edges
WHITE_K = 6504.0  # the correlated colour temperature of D65


def rig_by_text(rig: str) -> Tensor:
    """Unit directions [L, 3] of `--lights`."""
    parsed = parse_lights(rig)
    if isinstance(parsed, int):
        return rig_directions(parsed)
    azimuth, elevation = torch.tensor(parsed).T
    return azel_to_direction(azimuth, elevation)


def blackbody_rgb(kelvin: float) -> np.ndarray:
    """Linear Rec.709 [3] of a blackbody of 1667 to 25000 K, of luminance 1; 1, 1, 1 at `WHITE_K`.

    The Planckian locus is a little greener than D65: colours are divided by that of `WHITE_K`. What is
    outside Rec.709, as of candles, is clipped.
    """
    rgb = (_planckian_rgb(kelvin) / _planckian_rgb(WHITE_K)).clip(min=0)
    balanced: np.ndarray = rgb / luminance(rgb)
    return balanced


def _planckian_rgb(kelvin: float) -> np.ndarray:
    """Linear Rec.709 [3] of the Planckian locus, by Kang et al. 2002."""
    x, y = colour_science().temperature.CCT_to_xy_Kang2002(kelvin)
    return np.linalg.solve(rgb_to_xyz(REC709_CHROMATICITIES), np.array([x / y, 1.0, (1 - x - y) / y]))


def intensity_of(light: StudioLight) -> Tensor:
    """The light's colour times its strength [3], linear Rec.709."""
    tint = torch.ones(3) if light.kelvin is None else torch.from_numpy(blackbody_rgb(light.kelvin)).float()
    return torch.tensor(light.rgb) * tint * 2.0**light.stops


def far_samples(light: StudioLight) -> tuple[Tensor, Tensor]:
    """Unit directions [n, 3] of a far light and its share [n] in each; a surface that faces it receives 1."""
    if light.azel_deg is None:
        share = 4 / _AROUND  # the mean of a cosine over the sphere is 1 / 4
        return rig_directions(_AROUND), torch.full((_AROUND,), share)
    middle = azel_to_direction(*light.azel_deg)
    if light.size_deg == 0:  # to the last bit
        return middle[None], torch.ones(1)
    wide = 2 * math.tan(math.radians(light.size_deg / 2))
    directions = F.normalize(middle + wide * _grid(middle, light.size_deg), dim=1)
    return directions, torch.ones(len(directions)) / (directions @ middle).sum()


def is_narrow(directions: Tensor) -> bool:
    """Tell if the samples [n, 3] of a light lie so near each other that its shadows have edges."""
    middle = F.normalize(directions.mean(0), dim=0)
    return bool((directions @ middle).min() > math.cos(math.radians(_WIDEST_DEG / 2**0.5)))


def is_of_rig(directions: Tensor, lights: int = _AROUND) -> Tensor:
    """Which of directions [N, 3] are of a rig of so many lights; by default of light from all around."""
    return (directions[:, None] == rig_directions(lights)).all(-1).any(-1)


@dataclass(frozen=True, eq=False)
class PointLights:
    """The points of one near light, of rgb 1: places [P, 3] in metres, camera space.

    `toward` [3] is the unit vector from the light's middle to the face's centre; `strength` is irradiance
    times square metres of each point. `is_panel`: it shines by the cosine to `toward`, as a softbox does.
    """

    places_m: Tensor
    toward: Tensor
    strength: float
    is_panel: bool
    half_cone_deg: float | None = None

    @staticmethod
    def of(light: StudioLight, centre_m: Tensor) -> "PointLights":
        """Set up a near light about a face's centre [3]; a surface there that faces it receives 1."""
        assert light.at_m is not None
        offset = torch.tensor(light.at_m)
        distance_m = float(offset.norm())
        away = offset / distance_m
        wide_deg = _wide_deg(light)
        places = centre_m + offset + light.size_m * _grid(away, wide_deg)
        half = None if light.spot_deg is None else light.spot_deg / 2
        unit = PointLights(places, -away, 1.0, light.size_m > 0, half)
        directions, irradiance = unit.arriving(centre_m[:, None, None])
        received = float((irradiance[:, 0, 0] * (directions[:, 0, 0] @ away)).sum())
        return PointLights(places, -away, 1 / received, unit.is_panel, half)

    def arriving(self, positions_m: Tensor) -> tuple[Tensor, Tensor]:
        """Unit directions [P, H, W, 3] from positions [3, H, W] to the points, and irradiance [P, H, W].

        The irradiance is that of a surface that faces the point, and falls with the square of the distance.
        """
        offsets = self.places_m[:, None, None] - positions_m.permute(1, 2, 0)
        distances_m = offsets.norm(dim=-1).clamp_min(1e-6)
        directions = offsets / distances_m[..., None]
        aligned = (-directions @ self.toward).clamp(-1, 1)
        irradiance = self.strength / distances_m.clamp_min(_NEAREST_M).square()
        if self.is_panel:
            irradiance = irradiance * aligned.clamp_min(0)
        if self.half_cone_deg is not None:
            edge = (1 - torch.rad2deg(aligned.acos()) / self.half_cone_deg) / (1 - _FULL_CONE)
            inside = edge.clamp(0, 1)
            irradiance = irradiance * inside * inside * (3 - 2 * inside)
        return directions, irradiance


class KeyLight(NamedTuple):
    """A light whose shadows have edges: the number of its sum, and of that in which it shines alone.

    `samples` are its directions among those of far lights, or its place among near ones.
    """

    number: int
    alone: int
    is_near: bool
    samples: slice


def has_edges(light: StudioLight) -> bool:
    """True of a near light whose shadows have edges."""
    return _wide_deg(light) <= _WIDEST_DEG


def _wide_deg(light: StudioLight) -> float:
    """Angle of the side of a near light, as seen from the face."""
    assert light.at_m is not None
    return math.degrees(2 * math.atan2(light.size_m / 2, math.hypot(*light.at_m)))


def _grid(axis: Tensor, wide_deg: float) -> Tensor:
    """Offsets [n * n, 3] of the cells of a unit square about an axis [3], two of whose sides are level."""
    if wide_deg == 0:
        return torch.zeros(1, 3)
    side = min(max(2, math.ceil(wide_deg / _APART_DEG)), _MOST_A_SIDE)
    up = torch.tensor([0.0, 1.0, 0.0] if abs(float(axis[1])) < 0.99 else [0.0, 0.0, 1.0])
    across = F.normalize(torch.linalg.cross(up, axis), dim=0)
    along = torch.linalg.cross(axis, across)
    cells = (torch.arange(side) + 0.5) / side - 0.5
    v, u = torch.meshgrid(cells, cells, indexing="ij")
    return (u[..., None] * across + v[..., None] * along).view(-1, 3)
