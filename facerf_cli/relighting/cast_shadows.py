"""Shadows that key lights cast, at the photo's resolution.

The maps of a person are coarse, and so is the visibility V of a light in them: a nose's shadow is a soft
patch. Here rays are traced on a finer grid, where V changes on bare skin. R1 and R0 are what the network
draws where the light arrives and where it does not; the image of the light alone is multiplied by

    (R0 + V' (R1 - R0)) / (R0 + V (R1 - R0))

where V' is the fine visibility. The proxy is fitted, not measured: where a surface turns away from the light,
which shading shows already, and where something nearby is in the way, as a lid before an eye, V' is V.
"""

from typing import NamedTuple

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from facerf_cli.light.light import PointLights
from facerf_cli.light.transport import first_hits_m, on_disc, places_on_disc
from facerf_cli.portrait.parse import class_index
from facerf_cli.portrait.proxy import OFF_M, RADIUS_DEG, Proxy, ProxyMaps
from facerf_cli.raster.texture import inpaint, smoothstep
from facerf_cli.relighting.portrait_field import PortraitView

_BARE = [class_index(name) for name in ("skin", "lips", "beard", "ears", "neck")]
_CHANGES, _NEARBY_PX = 0.02, 2  # difference of V that is a change, and how near it is, in pixels of V
_RAYS = 8  # from each pixel of the grid
_PATTERN = 3  # pixels along the side of squares in which rays differ, and over which V' is averaged
_NEAR_M, _FAR_M = 0.004, 0.016  # distances at which a hit may be a fold of the proxy, and at which it is none
_FACING = 0.15  # cosine of normal and light from which on V' counts wholly
_DIM, _DARK = 0.02, 0.003  # share of R1, and radiance in the network's units, that are added to both
_MOST = 1.6  # of the change: beside a shadow V, which is blurred, is too small
_GOLDEN = 0.381966  # of a turn
_BEYOND_M = 100.0  # no hit is farther


class CastShadow(NamedTuple):
    """V' and V [2, s, s] of a key light in a view's square, and R0 and R1 [2, S, S]."""

    visible: Tensor
    shades: Tensor


def cast_shadow(view: PortraitView, light: Tensor | PointLights) -> CastShadow:
    """The shadow of a light, of directions [n, 3] to its samples or of points, in a view."""
    person, size = view.person, view.person.image.shape[1:]
    if isinstance(light, PointLights):
        ends, (lights, strength) = light.places_m, light.arriving(person.maps.positions_m)
        coarse, middle = person.shadows.toward(ends), -light.toward
    else:
        ends, lights, strength = light, light, torch.full((len(light), 1, 1), 1 / len(light))
        coarse, middle = person.shadows.along(light), F.normalize(light.mean(0), dim=0)
    shades = []
    for arrives in (0.0, 1.0):
        shade, glow, _ = view.maps.shaded(lights[None], torch.full((1, len(coarse), *size), arrives))
        shades.append((strength * (view.maps.albedo[0].mean(0) * shade[0] + glow[0])).sum(0))
    maps = person.finer
    wide = _enlarged(coarse.mean(0), maps.covered)
    facing = smoothstep(torch.einsum("cij,c->ij", maps.normals, middle) / _FACING)
    changes = _highest(coarse.mean(0)) + _highest(-coarse.mean(0)) > _CHANGES
    bare, changes = (_enlarged(one, maps.covered) for one in (person.classes[_BARE].sum(0), changes.float()))
    share = facing * maps.covered * bare * changes
    traced = share.numpy() > 0
    fine = wide.clone()
    fine[traced] = visibility(person.proxy, maps, traced, wide, ends, isinstance(light, PointLights))
    fine = F.avg_pool2d(fine[None], _PATTERN, 1, _PATTERN // 2, count_include_pad=False)[0]
    return CastShadow(
        torch.stack([torch.lerp(wide, fine, share), wide]), inpaint(torch.stack(shades), person.own_pixels)
    )


def visibility(
    proxy: Proxy, maps: ProxyMaps, traced: np.ndarray, coarse: Tensor, ends: Tensor, near: bool
) -> Tensor:
    """Visibility [N] of a light from N `traced` pixels [s, s] of a proxy's maps, by rays.

    Args:
        proxy: The mesh.
        maps: Its normals and positions [3, s, s].
        traced: The pixels.
        coarse: Visibility [s, s] that counts where a fold of the proxy is in the way.
        ends: Unit directions [n, 3] to samples of the light, camera space, or places in metres.
        near: True for places.
    """
    normals, points = (field.numpy()[:, traced].T for field in (maps.normals, maps.positions_m))
    origins = (points + OFF_M * normals).astype(np.float32)
    y, x = np.nonzero(traced)
    cell = (y % _PATTERN) * _PATTERN + x % _PATTERN  # so that a square has all rays
    cells, samples, otherwise = _PATTERN**2, ends.numpy(), coarse.numpy()[traced]
    found = np.zeros(len(origins), np.float32)
    for ray in range(_RAYS):
        place = (ray * cells + cell + 0.5) / (_RAYS * cells)  # 0 to 1
        axes = samples if len(samples) == 1 else samples[(place * len(samples)).astype(int)]
        reach_m: np.ndarray | float = _BEYOND_M
        if near:
            axes = axes - origins
            away_m = np.linalg.norm(axes, axis=1)
            axes = axes / away_m[:, None].clip(min=1e-6)
            reach_m = np.minimum(away_m, _BEYOND_M)
        turn = ((ray * cells + cell) * _GOLDEN) % 1
        radius = place if len(samples) == 1 else (place * len(samples)) % 1
        disc = places_on_disc(
            RADIUS_DEG, radius[:, None].astype(np.float32), turn[:, None].astype(np.float32)
        )
        hits_m = first_hits_m(proxy.scene, origins, on_disc(axes, disc)).clip(max=_BEYOND_M)
        folded = ((_FAR_M - hits_m) / (_FAR_M - _NEAR_M)).clip(0, 1)
        found += np.where(hits_m < reach_m, folded * otherwise, 1)
    return torch.from_numpy(found / _RAYS)


def change(shadow: CastShadow) -> Tensor:
    """The factor [h, w] of the light's image, by its shadow at pixels: V' and V, R0 and R1 [2, h, w]."""
    (fine, coarse), (dark, light) = shadow
    more, least = light - dark, dark + _DIM * light + _DARK
    return ((least + fine * more) / (least + coarse * more)).clamp(0, _MOST)


def _enlarged(map_: Tensor, like: Tensor) -> Tensor:
    return F.interpolate(map_[None, None], like.shape, mode="bilinear", align_corners=False)[0, 0]


def _highest(map_: Tensor) -> Tensor:
    return F.max_pool2d(map_[None], 2 * _NEARBY_PX + 1, 1, _NEARBY_PX)[0]
