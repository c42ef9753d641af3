"""Key lights of a map: a sun, or a small lamp, whose shadows have edges that the cells of a rig blur.

A key is a compact cluster of texels, at most `2 * _REACH_DEG` wide, that holds more than `_SHARE` of the
map's light: the texels about the brightest one that are at least `_BRIGHT` times as bright, with hardly any
as bright in the ring around them. It shines from its middle as one single light.
"""

import math
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from facerf_cli.image.colour import luminance
from facerf_cli.light.envmap import resampled
from facerf_cli.light.sphere import RigLight, latlong_directions, latlong_solid_angles

_SHARE = 0.2  # of a map's light
_REACH_DEG, _RING_DEG = 6.0, 12.0  # from its middle: of a key, and to which nothing else is as bright
_BRIGHT = 0.1  # of the brightest texel
_AROUND = 0.1  # of the key's light, in the ring
_ROWS = 256  # at most, of the map in which keys are found
_MOST = int(1 / _SHARE)


class MapKeys(NamedTuple):
    """A map [H, W, 3] without its keys, and these: unit directions [K, 3] and rgb weights [K, 3]."""

    rest: Tensor
    directions: Tensor
    weights: Tensor

    @staticmethod
    def none(envmap: Tensor) -> "MapKeys":
        """A map all of which is the rest."""
        return MapKeys(envmap, torch.zeros(0, 3), torch.zeros(0, 3))

    def turned(self, rotate_deg: float) -> RigLight:
        """The keys of the map with `rotate_deg` added to every azimuth."""
        turn = torch.deg2rad(torch.tensor(rotate_deg))
        x, y, z = self.directions.unbind(1)
        turned = torch.stack([x * turn.cos() + z * turn.sin(), y, z * turn.cos() - x * turn.sin()], 1)
        return RigLight(turned, self.weights)


def without_keys(envmap: Tensor) -> MapKeys:
    """Take the keys out of a lat-long map [H, W, 3]; a map without keys stays as it is."""
    rows = min(_ROWS, len(envmap))
    if 180 / rows > 2 * _REACH_DEG:  # a texel is no key
        return MapKeys.none(envmap)
    small = resampled(envmap, rows)
    towards, solid = latlong_directions(rows, 2 * rows), latlong_solid_angles(rows, 2 * rows, torch.float32)
    shown = torch.from_numpy(luminance(small.detach().numpy())).clamp_min(0)
    light = shown * solid
    left, keys = torch.ones_like(light), list[Tensor]()
    for _ in range(_MOST):
        seen = shown * left
        bright = light * left * (seen >= _BRIGHT * seen.max())
        near = bright * _within(towards, towards.view(-1, 3)[seen.argmax()], _RING_DEG)
        middle = F.normalize(torch.einsum("ij,ijc->c", near, towards), dim=0)
        key = (_within(towards, middle, _REACH_DEG) & (bright > 0)).float()
        held = (light * key).sum()
        around = (bright * _within(towards, middle, _RING_DEG)).sum() - held
        if held <= _SHARE * light.sum() or around > _AROUND * held:
            break
        keys.append(key)
        left = left * (1 - key)
    if not keys:
        return MapKeys.none(envmap)
    found = torch.stack(keys)
    middles = torch.einsum("kij,ij,ijc->kc", found, light, towards)
    weights = torch.einsum("kij,ij,ijc->kc", found, solid, small) / torch.pi
    return MapKeys(small * left[..., None], F.normalize(middles, dim=1), weights)


def _within(towards: Tensor, middle: Tensor, reach_deg: float) -> Tensor:
    """Which of directions [H, W, 3] lie within an angle of the middle [3]."""
    return towards @ middle >= math.cos(math.radians(reach_deg))
