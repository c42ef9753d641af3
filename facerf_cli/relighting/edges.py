"""Coarse maps at the edges of a photo, where they mix both sides, and along a person's outline.

Colours tell the sides of an edge apart: classes know no finger before a jacket. Pixels of the maps near an
edge take the values of pixels around them that have their colour and lie farther from any edge (`EdgeFill`).
So does plain cloth everywhere: where the proxy of the person ends on it, maps jump, and blocks show. A pixel
of the photo reads the maps at the centre of those pixels around it that have its colour (`places`); where all
of them have it, this is its own place.

Light from behind is seen where surfaces turn away, in a rim along the outline that is thinner than the pixels
of the maps (`Rims`). At a distance d inside the outline it is read from a distance g(d) in the maps, and
g'(d) times as bright: along the outline's normal its integral stays what it was. g(0) = 0, g'(0) is the
sharpness, and from the reach on g(d) = d. Deeper inside, the brightness fades to 0: the network also draws
such a light on cheek and nose, where hair or the head itself blocks it.
"""

import math
from itertools import product
from typing import NamedTuple

import numpy as np
import torch
import torch.nn.functional as F
from scipy.ndimage import distance_transform_edt, gaussian_filter
from scipy.sparse import csr_array
from torch import Tensor

from facerf_cli.image.strips import Window, enlarged, fitted
from facerf_cli.portrait.matte import shrunk
from facerf_cli.raster.texture import smoothstep

_NEAR_PX = 2  # distance from an edge within which maps are mixed, in their pixels
_EDGE = 0.12  # difference of colours of an edge
_REACH_PX, _SPREAD_PX = 4, 2.0  # of the pixels whose values one near an edge takes, and standard deviation
_ALIKE = 0.06  # difference of colours that count as the same
_FAR = 0.95  # share from which on pixels keep their values
_LEAST_TRUST, _LEAST_WEIGHT = 1e-4, 1e-3
_AT_ONCE = 1 << 14  # pixels whose like is found at once: they stay in the processor's cache
_BEHIND = (0.35, 0.75)  # -z of the directions from which on light is partly, and wholly, from behind
_RIM_SHARPNESS, _RIM_REACH = 2.0, 0.2  # g'(0), at most 4, and the reach, in extents of the face
_SMOOTH = 0.006  # standard deviation of the blur of the outline's distance, in extents of the face
_OUTSIDE = 0.015  # of the outline, in extents of the face, over which brightness fades to what it was
_FADES = (0.04, 0.16)  # distances inside the outline from which on light fades, and is none, in extents
_OUTLINE_PX = 640  # longest side of the photo in which distances are measured


class EdgeFill(NamedTuple):
    """Pixels [N] of maps [S, S], what they keep [N], and weights [N, S * S] of what they take."""

    pixels: Tensor
    kept: Tensor
    weights: csr_array

    @staticmethod
    def of(colours: Tensor, trust: Tensor, own: Tensor, kept: Tensor) -> "EdgeFill":
        """Pixels of colours [3, S, S] that keep a share below 1, `kept` [S, S], of their values.

        They take of a person's `own`, by their trust [S, S].
        """
        side, flat = own.shape[-1], colours.flatten(1)
        wide, trusted = (F.pad(part, (_REACH_PX,) * 4).flatten(-2) for part in (colours, trust * own))
        pixels = torch.nonzero(kept.flatten() < _FAR)[:, 0]
        steps = list(product(range(-_REACH_PX, _REACH_PX + 1), repeat=2))
        corner = pixels + pixels // side * 2 * _REACH_PX  # of the pixels around, with the border
        mine = flat[:, pixels]
        around = np.empty((len(pixels), len(steps)), np.int32)
        weights = np.empty(around.shape, np.float32)
        for number, (down, right) in enumerate(steps):
            at = corner + ((down + _REACH_PX) * (side + 2 * _REACH_PX) + right + _REACH_PX)
            likeness = _likeness(wide.index_select(1, at).sub_(mine).square_().sum(0))
            weight = likeness * trusted[at]  # 0 beyond the maps
            around[:, number] = pixels + (down * side + right)
            weights[:, number] = weight * math.exp(-(down**2 + right**2) / (2 * _SPREAD_PX**2))
        for _ in range(2):  # of what is left
            weights /= weights.sum(1, keepdims=True).clip(min=1e-12)
            weights *= weights > _LEAST_WEIGHT
        used = weights > 0
        ends = np.concatenate([[0], used.sum(1).cumsum()])
        taken = csr_array((weights[used], around[used], ends), (len(pixels), side**2))
        return EdgeFill(pixels, kept.flatten()[pixels], taken)

    def filled(self, maps: Tensor) -> Tensor:
        """Maps [C, S, S] with these pixels filled."""
        flat = maps.flatten(1).T.clone(memory_format=torch.contiguous_format)
        taken = torch.from_numpy(self.weights @ flat.numpy())
        flat[self.pixels] = torch.lerp(taken, flat[self.pixels], self.kept[:, None])
        return flat.T.reshape(maps.shape)


def colours_of(radiance: Tensor) -> Tensor:
    """Colours of radiance in the units of the Portrait Network, in which differences count alike."""
    return radiance.clamp(0, 2).sqrt()


def trust_in(colours: Tensor, solid: Tensor, loose: Tensor) -> Tensor:
    """Trust [S, S] in maps: nearly 0 near edges of colours [3, S, S] of what is `solid` [S, S], else 1.

    Elsewhere, as in the face, edges are features, and shade where the surface turns away; and what is `loose`
    [S, S], as hair, is all edges.
    """
    side = 2 * _NEAR_PX + 1
    high, low, near = (
        F.max_pool2d(part[None], side, 1, _NEAR_PX)[0] for part in (colours, -colours, solid[None])
    )
    edge = 1 - torch.exp(-(((high + low).amax(0) / _EDGE) ** 4))
    return (1 - edge * (2 * (near[0] - loose)).clamp(0, 1)).clamp_min(_LEAST_TRUST)


def places(colours: Tensor, trust: Tensor, grid: Tensor, radiance: Tensor, unit: float) -> Tensor:
    """Places [h, w, 2] in -1..1 of maps where pixels of a radiance [h, w, 3] find their like.

    Args:
        colours: Those of the maps [3, S, S].
        trust: Trust [S, S] in them.
        grid: The pixels' own places [h, w, 2].
        radiance: That of the pixels.
        unit: Radiance of 1 in the units of the Portrait Network.
    """
    side, near = colours.shape[-1], (trust < _FAR).float()[None, None]
    near_edge = F.grid_sample(near, grid[None], "nearest", "border", align_corners=False).flatten()
    found, around = grid.flatten(0, 1).clone(), F.pad(colours[None], (1, 2, 1, 2), mode="replicate")[0]
    for some in torch.split(near_edge.nonzero()[:, 0], _AT_ONCE):
        own = colours_of(radiance.flatten(0, 1)[some] / unit).T.contiguous()
        found[some] += _toward_its_like(around.flatten(1), found[some], own, side) * (2 / side)
    return found.view(grid.shape)


def _toward_its_like(around: Tensor, grid: Tensor, own: Tensor, side: int) -> Tensor:
    """Steps [N, 2] in pixels of maps from places [N, 2] in -1..1 to their like among the 4 x 4 pixels around.

    `own` are the colours [3, N] there, `around` those of the maps [3, (side + 3)^2] with a border.
    """
    x, y = ((grid + 1) * (side / 2) - 0.5).clamp(0, side - 1).T
    corner = y.long() * (side + 3) + x.long()  # of the 4 x 4 pixels
    across, down = (torch.stack([step - 1 + at.floor() - at for step in range(4)]) for at in (x, y))
    wide, high = 1 - across.abs() / 2, 1 - down.abs() / 2
    total, right, below = torch.zeros(3, len(x))
    for row, column in product(range(4), repeat=2):
        colours = around.index_select(1, corner + (row * (side + 3) + column))
        weight = _likeness(colours.sub_(own).square_().sum(0)).mul_(wide[column]).mul_(high[row])
        total += weight
        right.addcmul_(weight, across[column])
        below.addcmul_(weight, down[row])
    return torch.stack([right, below], -1) / total[:, None]


def _likeness(difference2: Tensor) -> Tensor:
    """Likeness of colours, in place; it falls slowly, so that a mixed pixel takes from both sides."""
    return difference2.div_(_ALIKE**2).square_().add_(1).reciprocal_()


def from_behind(directions: Tensor) -> Tensor:
    """Share [...] of lights from unit directions [..., 3] that comes from behind."""
    return smoothstep((-directions[..., 2] - _BEHIND[0]) / (_BEHIND[1] - _BEHIND[0]))


class Rims:
    """Rims: places from which a person's light from behind is read, and its brightness, by a matte [H, W].

    `face_px` is the extent of the face in the photo. The frame's border is no outline.
    """

    def __init__(self, matte: np.ndarray, face_px: float) -> None:
        self._size_px = matte.shape
        height, width = fitted(matte.shape[0], matte.shape[1], _OUTLINE_PX)
        inside = shrunk(matte, (height, width)) > 0.5
        self._maps = np.zeros((3, height, width), np.float32)
        self._maps[2] = 1
        if inside.all() or not inside.any():
            return
        face = face_px * height / matte.shape[0]  # in pixels of the maps
        from_outline = distance_transform_edt(inside) - 0.5, distance_transform_edt(~inside) - 0.5
        distance = np.where(inside, from_outline[0], -from_outline[1])
        distance = gaussian_filter(distance / face, _SMOOTH * face).astype(np.float32)
        inward = np.stack(np.gradient(distance)[::-1]) * face  # [2, h, w] x, y
        share = (distance / _RIM_REACH).clip(0, 1)
        more = _RIM_SHARPNESS - 1
        deeper = more * distance.clip(0) * (1 - share) ** 2
        slope = more * (1 - share) * (1 - 3 * share) * (1 + distance.clip(max=0) / _OUTSIDE).clip(0)
        self._maps[:2] = deeper * inward * face_px
        fading = smoothstep(torch.from_numpy((_FADES[1] - distance) / (_FADES[1] - _FADES[0]))).numpy()
        self._maps[2] = fading * (1 + slope * np.square(inward).sum(0).clip(max=1))

    def at(self, window: Window) -> tuple[Tensor, Tensor]:
        """Offsets [2, h, w] in pixels of the photo, x and y, and brightness [h, w]."""
        maps = enlarged(self._maps, self._size_px, window.rows)[..., window.columns]
        return torch.from_numpy(maps[:2]), torch.from_numpy(maps[2])
