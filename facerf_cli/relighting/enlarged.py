"""A view of a portrait field at the photo's own resolution.

Its maps are coarse. They are relit at their own resolution, enlarged, sharp at the photo's edges
(`edges.py`), and multiplied by the photo's detail (`detail.py`). Given normals have the photo's resolution:
what the maps lack of them changes the shading, to first order, over what it changes in the photo's own light.
"""

from collections.abc import Callable, Sequence
from functools import cached_property

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from facerf_cli.image.colour import ExposureRule, chosen_exposure_ev
from facerf_cli.image.strips import Window
from facerf_cli.portrait.parse import class_index
from facerf_cli.raster.camera import PIXEL_CENTRE
from facerf_cli.raster.texture import blurred, inpaint
from facerf_cli.relighting.cast_shadows import CastShadow, change
from facerf_cli.relighting.detail import finer_detail
from facerf_cli.relighting.edges import EdgeFill, Rims, colours_of, places, trust_in
from facerf_cli.relighting.portrait_field import PortraitLight, PortraitView
from facerf_cli.relighting.white import BARE

VIEW_LAYERS = ("albedo", "normal", "shadow", "specular")
_FEATHER = 0.3  # border of the square where a wider one takes over, in halves of its side
_GLOSS_PX = 0.8  # blur of highlights, which the network draws in pairs of pixels
_HAIR = ("hair", "beard")
_SOLID = ("glasses", "headwear", "garment", "hand")  # their edges are kept sharp
_MOST_CHANGE = 2.0  # of the shading by normals that are finer than the maps


Maps = dict[str, Tensor]  # of a view in a light, [C, S, S] by name


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
