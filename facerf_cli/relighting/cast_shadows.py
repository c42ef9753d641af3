"""Shadows cast by key lights, at the photo's resolution.

The maps of a person are coarse, and so is the visibility V of a light in them: a nose casts only a soft
patch. Here rays are traced on a finer grid where V changes on bare skin. Let R1 and R0 be the radiance that
the network predicts with and without the light. The image of the light on its own is multiplied by

    (R0 + V' (R1 - R0)) / (R0 + V (R1 - R0))

where V' is the fine visibility. The proxy is fitted, not measured. Therefore V' equals V where a surface
turns away from the light, which the shading already shows, and where an occluder is very close, like a lid in
front of an eye.
"""

from typing import NamedTuple

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from facerf_cli.light.light import PointLights
from facerf_cli.light.transport import first_hits_m, on_disc, places_on_disc
from facerf_cli.network.inputs import resize
from facerf_cli.portrait.person import PATTERN_PX
from facerf_cli.portrait.proxy import OFF_M, RADIUS_DEG, Proxy, ProxyMaps
from facerf_cli.raster.texture import inpaint, smoothstep
from facerf_cli.relighting.portrait_field import PortraitView

_CHANGES, _NEARBY_PX = 0.02, 2  # least change of V, and how close it must be, in pixels of V
_RAYS = 8  # per pixel of the grid
_NEAR_M, _FAR_M = 0.004, 0.016  # hits closer than this are folds of the proxy; hits beyond this are occluders
_FACING = 0.15  # cosine of normal and light above which V' has full weight
_DIM, _DARK = 0.02, 0.003  # added to both: fraction of R1, and radiance in the network's units
_MOST = 1.6  # largest factor: next to a shadow the blurred V is too small
_GOLDEN = 0.381966  # of a full turn
_BEYOND_M = 100.0  # upper limit of hit distances


class CastShadow(NamedTuple):
    """Shadow of a key light in a view: V' and V as [2, s, s], R0 and R1 as [2, S, S]."""

    visible: Tensor
    shades: Tensor


def cast_shadow(view: PortraitView, light: Tensor | PointLights) -> CastShadow:
    """Compute the shadow of a light in a view; the light is directions [n, 3] of its samples, or points."""
    person, pixels, seen = view.person, view.pixels, view.shaded_maps
    if isinstance(light, PointLights):
        ends, (lights, strength) = light.places_m, light.arriving(pixels.values(person.maps.positions_m))
        coarse, middle = person.shadows.toward(ends), -light.toward
    else:
        ends, lights, strength = light, light, torch.full((len(light), 1, 1), 1 / len(light))
        coarse, middle = person.shadows.along(light), F.normalize(light.mean(0), dim=0)
    shades = []
    for visible in (0.0, 1.0):
        everywhere = torch.full((1, len(coarse), *seen.hair.shape[2:]), visible)
        shading, specular, _ = seen.shaded(lights[None], everywhere)
        radiance = seen.albedo[0].mean(0) * shading[0] + specular[0]
        shades.append((strength * radiance).sum(0))
    (maps, window), size_px = person.finer, person.finer_size_px
    changes = _highest(coarse.mean(0)) + _highest(-coarse.mean(0)) > _CHANGES
    wide, bare, changes = (
        resize(one[None, None], size_px)[0, 0] for one in (coarse.mean(0), person.bare, changes.float())
    )
    around = wide[window]
    facing = smoothstep(torch.einsum("cij,c->ij", maps.normals, middle) / _FACING)
    weight = facing * maps.covered * bare[window] * changes[window]
    traced = weight.numpy() > 0
    fine = around.clone()
    fine[traced] = visibility(person.proxy, maps, traced, around, ends, isinstance(light, PointLights))
    fine = F.avg_pool2d(fine[None], PATTERN_PX, 1, PATTERN_PX // 2, count_include_pad=False)[0]
    sharp = wide.clone()
    sharp[window] = torch.lerp(around, fine, weight)
    shade = inpaint(pixels.maps(torch.stack(shades)), person.own_pixels)
    return CastShadow(torch.stack([sharp, wide]), shade)


def visibility(
    proxy: Proxy, maps: ProxyMaps, traced: np.ndarray, coarse: Tensor, ends: Tensor, near: bool
) -> Tensor:
    """Trace the visibility [N] of a light from the N `traced` pixels [s, s] of a proxy's maps.

    `coarse` [s, s] is used where a fold of the proxy is in the way. `ends` [n, 3] are unit directions to
    samples of the light or, if it is `near`, positions in metres, in camera space.
    """
    normals, points = (field.numpy()[:, traced].T for field in (maps.normals, maps.positions_m))
    origins = (points + OFF_M * normals).astype(np.float32)
    y, x = np.nonzero(traced)
    cell = (y % PATTERN_PX) * PATTERN_PX + x % PATTERN_PX  # each square contains all rays
    cells, samples, otherwise = PATTERN_PX**2, ends.numpy(), coarse.numpy()[traced]
    total = np.zeros(len(origins), np.float32)
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
        total += np.where(hits_m < reach_m, folded * otherwise, 1)
    return torch.from_numpy(total / _RAYS)


def change(shadow: CastShadow) -> Tensor:
    """Return the factor [h, w] of the light's image from V' and V, R0 and R1 at pixels, each [2, h, w]."""
    (fine, coarse), (dark, light) = shadow
    more, least = light - dark, dark + _DIM * light + _DARK
    return ((least + fine * more) / (least + coarse * more)).clamp(0, _MOST)


def _highest(map_: Tensor) -> Tensor:
    return F.max_pool2d(map_[None], 2 * _NEARBY_PX + 1, 1, _NEARBY_PX)[0]
