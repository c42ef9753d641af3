"""A view of a portrait field at the photo's own resolution.

Its maps are coarse. They are relit at their own resolution, enlarged, sharp at the photo's edges
(`edges.py`), and multiplied by the photo's detail (`detail.py`). Given normals have the photo's resolution:
what the maps lack of them changes the shading, to first order, over what it changes in the photo's own light.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from facerf_cli.image.colour import ExposureRule, chosen_exposure_ev
from facerf_cli.portrait.classes import class_index
from facerf_cli.raster.camera import PIXEL_CENTRE
from facerf_cli.raster.texture import blurred, inpaint
from facerf_cli.relighting.cast_shadows import CastShadow, change
from facerf_cli.relighting.detail import finer_detail
from facerf_cli.relighting.edges import EdgeFill, colours_of, places, trust_in
from facerf_cli.relighting.portrait_field import PortraitLight, PortraitView
from facerf_cli.relighting.rims import Rims
from facerf_cli.relighting.white import BARE

_FEATHER = 0.3  # border of the square where a wider one takes over, in halves of its side
_GLOSS_PX = 0.8  # blur of highlights, which the network draws in pairs of pixels
_HAIR = ("hair", "beard")
_SOLID = ("glasses", "headwear", "garment", "hand")  # their edges are kept sharp
_MOST_CHANGE = 2.0  # of the shading by normals that are finer than the maps


@dataclass(frozen=True, eq=False)
class ViewRows:
    """Values in some rows and columns of the photo that no light changes.

    Attributes:
        grid: Places [h, w, 2] in the maps where the pixels find their like, in -1..1.
        albedo: The albedo with the photo's detail [3, h, w].
        detail: The photo's detail, a factor of what is relit [3, h, w].
        finer: What given normals have over those of the maps [3, h, w].
    """

    rows: slice
    columns: slice
    grid: Tensor
    albedo: Tensor
    detail: Tensor
    finer: Tensor | None = None


@dataclass(frozen=True, eq=False)
class ViewLight:
    """Light from the front and from behind: shading and highlights [6, S, S] each, continued and smooth.

    Where normals are given, `slopes` [9, S, S] are those of the `PortraitLight`.
    """

    front: Tensor
    rear: Tensor
    slopes: Tensor | None = None


class Enlarged:
    """The person of a view under sums of lights, over the photo [H, W, 3]."""

    def __init__(self, view: PortraitView, size_px: tuple[int, int]) -> None:
        self._view, self._size_px = view, size_px
        classes = view.person.classes
        self.own = view.person.own_pixels
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

    def weight(self, rows: slice, among: slice) -> tuple[slice, np.ndarray]:
        """Those among columns in which the square is seen in some rows, and its weight [h, w] there."""
        square = self._view.person.square
        ends = (round(x) for x in (square.x0_px, square.x0_px + square.side_px))
        columns = slice(*(min(max(end, among.start), among.stop) for end in ends))
        x, y = self._places(rows, columns)
        away = torch.maximum(x.abs()[None], y.abs()[:, None])
        return columns, ((1 - away) / _FEATHER).clamp(0, 1).numpy()

    def observe(self, pixels: np.ndarray, rows: slice, columns: slice) -> ViewRows:
        """Read pixels [h, w, 3] of the photo, as far as no light changes them."""
        grid, unit = self._grid(rows, columns), self._view.person.exposure
        grid = places(self._colours, self._trust, grid, torch.from_numpy(pixels), unit)
        albedo, source, skin = torch.split(_enlarged(self._fixed_maps, grid), [3, 3, 1])
        source, skin = (maps.permute(1, 2, 0) for maps in (source, skin))
        detail = finer_detail(torch.from_numpy(pixels / unit), source, skin, self._view.typical_skin)
        detail = detail.permute(2, 0, 1)
        return ViewRows(rows, columns, grid, albedo * detail, detail, self._finer(rows, columns, grid))

    @cached_property
    def _normals(self) -> Tensor:
        """Normals [3, S, S] of the maps, continued."""
        return self._filled(self._edges.filled(self._view.maps.normals[0]))

    def _finer(self, rows: slice, columns: slice, grid: Tensor) -> Tensor | None:
        """Given normals less those of the maps at places [h, w, 2], [3, h, w]; 0 where none are."""
        if self._view.person.normals is None:
            return None
        given = torch.from_numpy(self._view.person.normals[rows, columns]).permute(2, 0, 1)
        return (given - _enlarged(self._normals, grid)) * given.any(0)

    def ready(self, light: PortraitLight) -> ViewLight:
        """Light [3, S, S] that can be read at any pixel, in the photo's units."""
        unit = self._view.exposure.repeat(2, 1, 1)
        front = unit * self._smooth(torch.cat([light.shading, light.highlights]))
        rear = unit * self._smooth(light.behind) if light.behind.any() else light.behind
        if light.slopes is None:
            return ViewLight(front, rear)
        slopes = self._filled(self._edges.filled(light.slopes))
        return ViewLight(front, rear, self._view.exposure.repeat_interleave(3, 0) * slopes)

    def radiance(self, light: ViewLight, seen: ViewRows, rims: Rims | None) -> np.ndarray:
        """Radiance [h, w, 3] under light but that from behind; with `rims` that follows [h, w, 6]."""

        def lit(maps: Tensor, grid: Tensor) -> Tensor:
            shading, highlights = _enlarged(maps, grid).chunk(2)
            return seen.albedo * shading + seen.detail * highlights

        parts = [lit(light.front, seen.grid)]
        if rims is not None:
            offsets_px, brightness = rims.at(seen.rows, seen.columns)
            offsets = offsets_px.permute(1, 2, 0) * (2 / self._view.person.square.side_px)
            parts.append(lit(light.rear, seen.grid + offsets) * brightness)
        return _by_pixel(torch.cat(parts))

    def change_by_normals(self, light: ViewLight, seen: ViewRows) -> np.ndarray:
        """Factor [h, w, 3] of an image by given normals, over that of the photo's own light."""
        if seen.finer is None or self._own_light is None:
            return np.ones((*seen.grid.shape[:2], 3), np.float32)

        def change(light: ViewLight, finer: Tensor) -> Tensor:
            assert light.slopes is not None
            maps = _enlarged(torch.cat([light.front[:3], light.slopes]), seen.grid)
            shading, slopes = maps[:3], maps[3:]
            added = (slopes.view(3, 3, *finer.shape[1:]) * finer).sum(1)
            return (1 + added / shading.clamp_min(1e-6)).clamp(1 / _MOST_CHANGE, _MOST_CHANGE)

        return _by_pixel(change(light, seen.finer) / change(self._own_light, seen.finer))

    def layer_maps(self, name: str, light: PortraitLight) -> Tensor:
        """Maps [C, S, S] of a layer under a light [3, S, S]; see `PersonInPhoto.layer`."""
        if name == "albedo":
            return self._fixed_maps[:3]
        if name == "normal":
            return self._normals
        light = light.whole
        maps = {
            "specular": light.highlights.clamp_min(0) * self._view.exposure,
            "shadow": light.reached,
        }[name]
        return self._filled(self._edges.filled(maps))

    def change(self, shadow: CastShadow, rows: slice, columns: slice) -> np.ndarray:
        """Factor [h, w] of a light's image by the shadow that it casts."""
        grid = self._grid(rows, columns)
        return np.asarray(change(CastShadow(*(_enlarged(maps, grid) for maps in shadow))).numpy())

    def layer(self, name: str, maps: Tensor, seen: ViewRows) -> np.ndarray:
        """A layer [h, w, 3] of observed pixels, by its `layer_maps`."""
        if name == "albedo":
            return _by_pixel(seen.albedo * self._view.exposure)
        values = _enlarged(maps, seen.grid)
        return _by_pixel(values if name != "normal" or seen.finer is None else values + seen.finer)

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

    def _grid(self, rows: slice, columns: slice) -> Tensor:
        """Places [h, w, 2] in the maps, in -1..1, of some of the photo's pixels."""
        x, y = self._places(rows, columns)
        return torch.stack([x.expand(len(y), -1), y[:, None].expand(-1, len(x))], -1)

    def _places(self, rows: slice, columns: slice) -> tuple[Tensor, Tensor]:
        """Places of columns [w] and rows [h] of the photo in the square, in -1..1."""
        square = self._view.person.square
        height, width = self._size_px
        x = 2 * (torch.arange(width)[columns] + PIXEL_CENTRE - square.x0_px) / square.side_px - 1
        y = 2 * (torch.arange(height)[rows] + PIXEL_CENTRE - square.y0_px) / square.side_px - 1
        return x.float(), y.float()


def _enlarged(maps: Tensor, grid: Tensor) -> Tensor:
    """Maps [C, h, w] at places [h, w, 2]; beyond the square those at its border repeat."""
    return F.grid_sample(maps[None], grid[None], padding_mode="border", align_corners=False)[0]


def _by_pixel(values: Tensor) -> np.ndarray:
    """Values [h, w, C] of maps [C, h, w]."""
    return values.permute(1, 2, 0).numpy()
