"""A view of a portrait field at the photo's own resolution.

Its maps are coarse. They are relit at their own resolution, enlarged, sharp at the photo's edges, and
multiplied by the photo's detail (`detail.py`). Given normals have the photo's resolution: what the maps lack
of them changes the shading, to first order, over what it changes in the photo's own light.

At edges of the photo coarse maps mix both sides: a finger and the cloth behind it. Colours tell the sides
apart: classes know no finger before a jacket. Pixels of the maps near an edge take the values of pixels
around them that have their colour and lie farther from any edge (`EdgeFill`). So does plain cloth everywhere:
where the proxy of the person ends on it, maps jump, and blocks show. A pixel of the photo reads the maps at
the centre of those pixels around it that have its colour (`places`); where all of them have it, this is its
own place.

Light from behind is seen where surfaces turn away, in a rim along the outline that is thinner than the pixels
of the maps (`Rims`). At a distance d inside the outline it is read from a distance g(d) in the maps, and
g'(d) times as bright: along the outline's normal its integral stays what it was. g(0) = 0, g'(0) is the
sharpness, and from the reach on g(d) = d. Deeper inside, the brightness fades to 0: the network also draws
such a light on cheek and nose, where hair or the head itself blocks it.
"""

import math
from collections.abc import Callable, Sequence
from functools import cached_property
from itertools import product
from typing import NamedTuple

import numpy as np
import torch
import torch.nn.functional as F
from scipy.ndimage import distance_transform_edt, gaussian_filter
from scipy.sparse import csr_array
from torch import Tensor

from facerf_cli.image.colour import ExposureRule, chosen_exposure_ev
from facerf_cli.image.strips import Window, enlarged, fitted
from facerf_cli.portrait.matte import shrunk
from facerf_cli.portrait.parse import class_index
from facerf_cli.raster.camera import PIXEL_CENTRE
from facerf_cli.raster.texture import blurred, inpaint, smoothstep
from facerf_cli.relighting.cast_shadows import CastShadow, change
from facerf_cli.relighting.detail import finer_detail
from facerf_cli.relighting.portrait_field import PortraitLight, PortraitView
from facerf_cli.relighting.white import BARE

_NEAR_PX = 2  # distance from an edge within which maps are mixed, in their pixels
_EDGE = 0.12  # difference of colours of an edge
_REACH_PX, _SPREAD_PX = 4, 2.0  # of the pixels whose values one near an edge takes, and standard deviation
_ALIKE = 0.06  # difference of colours that count as the same
_FAR = 0.95  # share from which on pixels keep their values
_LEAST_TRUST, _LEAST_WEIGHT = 1e-4, 1e-3
_AT_ONCE = 1 << 14  # pixels whose like is found at once: they stay in the processor's cache
_RIM_SHARPNESS, _RIM_REACH = 2.0, 0.2  # g'(0), at most 4, and the reach, in extents of the face
_SMOOTH = 0.006  # standard deviation of the blur of the outline's distance, in extents of the face
_OUTSIDE = 0.015  # of the outline, in extents of the face, over which brightness fades to what it was
_FADES = (0.04, 0.16)  # distances inside the outline from which on light fades, and is none, in extents
_OUTLINE_PX = 640  # longest side of the photo in which distances are measured
VIEW_LAYERS = ("albedo", "normal", "shadow", "specular")
_FEATHER = 0.3  # border of the square where a wider one takes over, in halves of its side
_GLOSS_PX = 0.8  # blur of highlights, which the network draws in pairs of pixels
_HAIR = ("hair", "beard")
_SOLID = ("glasses", "headwear", "garment", "hand")  # their edges are kept sharp
_MOST_CHANGE = 2.0  # of the shading by normals that are finer than the maps

Maps = dict[str, Tensor]  # of a view in a light, [C, S, S] by name


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


class Enlarged:
    """The person of a view under sums of lights, over the photo [H, W, 3]."""

    def __init__(self, view: PortraitView) -> None:
        self._view = view
        classes = view.person.classes
        self.own = view.person.own_pixels
        self._unit, self._typical_skin = view.person.exposure, view.typical_skin
        self._colours = colours_of(view.person.exposed)
        hair, solid = (
            classes[[class_index(name) for name in names]].sum(0, keepdim=True) for names in (_HAIR, _SOLID)
        )
        self._trust = 1 - self.own * (1 - trust_in(self._colours, solid[0], hair[0]))
        kept = self._trust * (1 - classes[class_index("garment")])
        self._edges = EdgeFill.of(self._colours, self._trust, self.own, kept)
        coloured = torch.cat([view.maps.albedo[0], view.person.exposed])
        coloured = self._filled(self._edges.filled(coloured))
        self._fixed_maps = torch.cat([coloured, classes[BARE].sum(0, keepdim=True)])
        self._own_light = None if view.own is None else self.ready(view.own)

    def weight(self, among: Window) -> tuple[Window, np.ndarray]:
        """The columns of a window in which the square is seen, and its weight [h, w] there."""
        square = self._view.person.square
        ends = (round(x) for x in (square.x0_px, square.x0_px + square.side_px))
        columns = slice(*(min(max(end, among.columns.start), among.columns.stop) for end in ends))
        part = Window(among.rows, columns)
        x, y = self._places(part)
        away = torch.maximum(x.abs()[None], y.abs()[:, None])
        return part, ((1 - away) / _FEATHER).clamp(0, 1).numpy()

    @cached_property
    def _normals(self) -> Tensor:
        """Normals [3, S, S] of the maps, continued."""
        return self._filled(self._edges.filled(self._view.maps.normals[0]))

    def ready(self, light: PortraitLight, layers: Sequence[str] = (), behind: bool = False) -> Maps:
        """Maps of a light [3, S, S] that can be read at any pixel, in the photo's units.

        "rgb", and "behind" if asked for, are shading and highlights [6, S, S]; where normals are given,
        "slopes" [9, S, S] are there, too. `layers` are some of `VIEW_LAYERS`.
        """
        unit = self._view.exposure.repeat(2, 1, 1)
        maps = {"rgb": unit * self._smooth(torch.cat([light.shading, light.highlights]))}
        if behind:
            maps["behind"] = unit * self._smooth(light.behind)
        if light.slopes is not None:
            slopes = self._filled(self._edges.filled(light.slopes))
            maps["slopes"] = self._view.exposure.repeat_interleave(3, 0) * slopes
        for name in layers:
            if name == "specular":
                shown = light.whole.highlights.clamp_min(0) * self._view.exposure
                maps[name] = self._filled(self._edges.filled(shown))
            elif name == "shadow":
                maps[name] = self._filled(self._edges.filled(light.reached))
            else:
                maps[name] = self._normals if name == "normal" else self._fixed_maps[:3]
        return maps

    def over(
        self, window: Window, pixels: np.ndarray, rims: Rims | None = None
    ) -> Callable[[Maps], dict[str, np.ndarray]]:
        """What gives a window of the photo, whose pixels are [h, w, 3], under a light of `ready`.

        "rgb" [h, w, 3] is the radiance under light from the front, and "behind" under that from behind, drawn
        as `rims`; "change" is the factor of both by given normals; others are layers.
        """
        grid, albedo, detail = self._unlit(window, pixels)
        finer = self._finer(window, grid)
        own = None if finer is None or self._own_light is None else _change(self._own_light, grid, finer)
        if rims is not None:
            offsets_px, brightness = rims.at(window)
            inward = grid + offsets_px.permute(1, 2, 0) * (2 / self._view.person.square.side_px)

        def lit(maps: Maps) -> dict[str, np.ndarray]:
            shading, highlights = _enlarged(maps["rgb"], grid).chunk(2)
            found = {"rgb": albedo * shading + detail * highlights}
            if "behind" in maps:
                shading, highlights = _enlarged(maps["behind"], inward).chunk(2)
                found["behind"] = (albedo * shading + detail * highlights) * brightness
            if own is not None and finer is not None:
                found["change"] = _change(maps, grid, finer) / own
            if "albedo" in maps:
                found["albedo"] = albedo * self._view.exposure
            for name in maps.keys() & {"normal", "shadow", "specular"}:
                found[name] = _enlarged(maps[name], grid)
            if "normal" in maps and finer is not None:
                found["normal"] = found["normal"] + finer
            return {name: _by_pixel(values) for name, values in found.items()}

        return lit

    def _unlit(self, window: Window, pixels: np.ndarray) -> tuple[Tensor, Tensor, Tensor]:
        """Places [h, w, 2] in the maps, in -1..1, where pixels find their like, and values [3, h, w] there.

        They are the albedo with the photo's detail, and that detail, a factor of what is relit.
        """
        grid = places(self._colours, self._trust, self._grid(window), torch.from_numpy(pixels), self._unit)
        albedo, source, skin = torch.split(_enlarged(self._fixed_maps, grid), [3, 3, 1])
        source, skin = (maps.permute(1, 2, 0) for maps in (source, skin))
        detail = finer_detail(torch.from_numpy(pixels / self._unit), source, skin, self._typical_skin)
        detail = detail.permute(2, 0, 1)
        return grid, albedo * detail, detail

    def _finer(self, window: Window, grid: Tensor) -> Tensor | None:
        """Given normals less those of the maps at places [h, w, 2], [3, h, w]; 0 where none are."""
        if self._view.person.normals is None:
            return None
        given = torch.from_numpy(self._view.person.normals[window]).permute(2, 0, 1)
        return (given - _enlarged(self._normals, grid)) * given.any(0)

    def change(self, shadow: CastShadow, window: Window) -> np.ndarray:
        """Factor [h, w] of a light's image by the shadow that it casts."""
        grid = self._grid(window)
        return np.asarray(change(CastShadow(*(_enlarged(maps, grid) for maps in shadow))).numpy())

    def exposure_ev(self, light: PortraitLight, own: Tensor, rule: ExposureRule) -> float:
        """The exposure in EV, by a rule, of the person under a light [3, S, S] and its own [3]."""
        view = self._view
        (relit,) = view.relit(light)
        relit = relit + own[:, None, None] * view.person.image
        skin = view.person.classes[class_index("skin")].numpy()
        image = view.person.image.permute(1, 2, 0).numpy()
        return chosen_exposure_ev(rule, _by_pixel(relit), image, skin, self.own.numpy())

    def _smooth(self, light: Tensor) -> Tensor:
        """Shading and highlights [6, S, S], continued over the background; highlights are blurred."""
        shading, highlights = torch.chunk(self._filled(light), 2)
        return self._filled(self._edges.filled(torch.cat([shading, blurred(highlights, _GLOSS_PX)])))

    def _filled(self, maps: Tensor) -> Tensor:
        """Maps [C, S, S] with the person's values continued over the background."""
        return inpaint(maps, self.own)

    def _grid(self, window: Window) -> Tensor:
        """Places [h, w, 2] in the maps, in -1..1, of some of the photo's pixels."""
        x, y = self._places(window)
        return torch.stack([x.expand(len(y), -1), y[:, None].expand(-1, len(x))], -1)

    def _places(self, window: Window) -> tuple[Tensor, Tensor]:
        """Places of columns [w] and rows [h] of the photo in the square, in -1..1."""
        square = self._view.person.square
        y, x = (torch.arange(part.start, part.stop) + PIXEL_CENTRE for part in window)
        x, y = (2 * (at - first) / square.side_px - 1 for at, first in ((x, square.x0_px), (y, square.y0_px)))
        return x.float(), y.float()


def _change(maps: Maps, grid: Tensor, finer: Tensor) -> Tensor:
    """Factor [3, h, w] of an image at places [h, w, 2] by what normals have over the maps, [3, h, w]."""
    lit = _enlarged(torch.cat([maps["rgb"][:3], maps["slopes"]]), grid)
    shading, slopes = lit[:3], lit[3:]
    added = (slopes.view(3, 3, *finer.shape[1:]) * finer).sum(1)
    return (1 + added / shading.clamp_min(1e-6)).clamp(1 / _MOST_CHANGE, _MOST_CHANGE)


def _enlarged(maps: Tensor, grid: Tensor) -> Tensor:
    """Maps [C, h, w] at places [h, w, 2]; beyond the square those at its border repeat."""
    return F.grid_sample(maps[None], grid[None], padding_mode="border", align_corners=False)[0]


def _by_pixel(values: Tensor) -> np.ndarray:
    """Values [h, w, C] of maps [C, h, w]."""
    return values.permute(1, 2, 0).numpy()
