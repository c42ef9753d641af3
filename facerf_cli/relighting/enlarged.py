"""A view of a portrait field at the photo's own resolution.

Its maps are coarse. The gain is enlarged with the photo as a guide, so that the photo without its light keeps
every pore and hair; bias, shading and highlights are smooth, but for the photo's edges (`edges.py`).
"""

from collections.abc import Callable

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from facerf_cli.face.landmarks import display_ev, to_display
from facerf_cli.image.colour import ExposureRule, chosen_exposure_ev, luminance
from facerf_cli.image.strips import remembered
from facerf_cli.portrait.classes import class_index
from facerf_cli.portrait.matte import local_lines
from facerf_cli.raster.camera import PIXEL_CENTRE
from facerf_cli.raster.texture import blurred, inpaint
from facerf_cli.relighting.cast_shadows import CastShadow, change
from facerf_cli.relighting.edges import EdgeFill, colours_of, places, trust_in
from facerf_cli.relighting.portrait_field import PortraitLight, PortraitView
from facerf_cli.relighting.rims import Rims

_REACH_PX, _SMOOTHNESS = 2, 1e-3  # of the guided filter, in pixels of the square, and variance of its guide
_ALBEDO_MAPS = 15  # slopes and offsets of the gain, and the bias
_FEATHER = 0.3  # border of the square where a wider one takes over, in halves of its side
_GLOSS_PX = 0.8  # blur of highlights, which the network draws in pairs of pixels
_STRAND_RANGE = (0.3, 3.0)  # of an albedo over that of the maps: strands of hair break up its highlights
_HAIR = ("hair", "beard")
_SOLID = ("glasses", "headwear", "garment", "hand")  # their edges are kept sharp
_SURE = 0.5  # share of the person from which on a pixel of the maps is its own

# Values [h, w, C] for the photo's pixels [h, w, 3], not negative, in some rows and columns.
Shown = Callable[[np.ndarray, slice, slice], np.ndarray]


class Enlarged:
    """The person of a view under sums of lights, over the photo [H, W, 3]."""

    def __init__(self, view: PortraitView, photo: np.ndarray) -> None:
        self._view, self._size_px = view, photo.shape[:2]
        self._display_ev = display_ev(photo)
        classes = view.person.classes
        self.own = (1 - classes[0] > _SURE).float()
        self._colours = colours_of(view.person.image / view.person.exposure)
        hair, solid = (
            classes[[class_index(name) for name in names]].sum(0, keepdim=True) for names in (_HAIR, _SOLID)
        )
        self._trust = 1 - self.own * (1 - trust_in(self._colours, solid[0], hair[0]))
        kept = self._trust * (1 - classes[class_index("garment")])
        self._edges = EdgeFill.of(self._colours, self._trust, self.own, kept)
        self._hair = torch.cat([self._filled(view.maps.albedo[0].mean(0, keepdim=True)), hair])
        self._albedo_maps = torch.cat(
            [self._gain_lines(), self._filled(self._edges.filled(view.maps.bias[0]))]
        )
        self._alike = remembered(self._places_alike)
        self._seen = remembered(self._without_light)

    @property
    def pixel_px(self) -> float:
        """Side of the maps' pixels in those of the photo."""
        return 1 / self._view.person.square.scale

    def weight(self, rows: slice) -> tuple[slice, np.ndarray]:
        """Columns of the photo in which the square is seen in some rows, and its weight [h, w] there."""
        square, width = self._view.person.square, self._size_px[1]
        first, last = (round(x) for x in (square.x0_px, square.x0_px + square.side_px))
        columns = slice(min(max(first, 0), width), min(max(last, 0), width))
        x, y = self._places(rows, columns)
        away = torch.maximum(x.abs()[None], y.abs()[:, None])
        return columns, ((1 - away) / _FEATHER).clamp(0, 1).numpy()

    def relit(self, lit: Tensor, display_ev: float, rims: Rims | None) -> Shown:
        """Radiance [h, w, 3] under the light of maps [15, S, S], but for that from behind.

        With `rims` that from behind is there, too, apart: [h, w, 6]. `display_ev` is the exposure at which
        the photo is shown to the guided filter.
        """
        light = PortraitLight.of(lit[None])
        front = self._smooth(torch.cat([light.shading, light.highlights], 1)[0])
        rear = light.behind[0] if rims is None else self._smooth(light.behind[0])

        def of(pixels: np.ndarray, rows: slice, columns: slice) -> np.ndarray:
            grid = self._alike((rows, columns), pixels)
            albedo, strands = self._seen((rows, columns), pixels, display_ev)

            def radiance(light: Tensor) -> Tensor:
                shading, highlights = light.chunk(2)
                return albedo * shading + highlights * strands

            parts = [radiance(_enlarged(front, grid))]
            if rims is not None:
                offsets_px, brightness = rims.at(rows, columns)
                offsets = offsets_px.permute(1, 2, 0) * (2 / self._view.person.square.side_px)
                # Strands that stand before such a light show one by one.
                behind = radiance(_enlarged(rear, grid + offsets))
                parts.append(behind * (brightness * strands))
            return _by_pixel(torch.cat([part * self._view.exposure for part in parts]))

        return of

    def _without_light(
        self, where: tuple[slice, slice], pixels: np.ndarray, display_ev: float
    ) -> tuple[Tensor, Tensor]:
        """The photo without its light [3, h, w] in rows and columns, and what strands do to highlights."""
        wide = _enlarged(torch.cat([self._albedo_maps, self._hair]), self._alike(where, pixels))
        albedo, hair = self._albedo(pixels, wide, display_ev), wide[_ALBEDO_MAPS:]
        finer = (albedo.mean(0) / hair[0].clamp_min(1e-4)).clamp(*_STRAND_RANGE)
        return albedo, torch.lerp(torch.ones_like(finer), finer, hair[1])

    def without_light(self, display_ev: float) -> Shown:
        """Luminances [h, w, 2] of the photo without its light, by the guided gain and by the coarse one."""
        maps = torch.cat([self._albedo_maps, self._filled(self._view.maps.gain[0])])

        def of(pixels: np.ndarray, rows: slice, columns: slice) -> np.ndarray:
            wide = _enlarged(maps, self._grid(rows, columns))
            gains = self._gain(pixels, wide, display_ev), wide[_ALBEDO_MAPS:]
            return np.stack([luminance(_by_pixel(gain) * pixels) for gain in gains], -1)

        return of

    def sharpened(self, pixels: np.ndarray, rows: slice, columns: slice) -> np.ndarray:
        """Share [h, w, 1] of the maps' values at the photo's pixels that are sharpened."""
        return _by_pixel(_enlarged(1 - self._trust[None], self._grid(rows, columns)))

    def layer(self, name: str, lit: Tensor) -> Shown:
        """A layer of an image under the light of maps [15, S, S]; see `WholePerson.layer`."""

        def read(maps: Tensor, pixels: np.ndarray, rows: slice, columns: slice) -> Tensor:
            return _enlarged(maps, self._alike((rows, columns), pixels))

        if name == "albedo":
            return lambda pixels, *where: _by_pixel(
                self._albedo(pixels, read(self._albedo_maps, pixels, *where), self._display_ev)
                * self._view.exposure
            )
        light = PortraitLight.of(lit[None]).whole
        maps = {
            "specular": light.highlights[0].clamp_min(0) * self._view.exposure,
            "shadow": light.reached[0],
            "normal": self._view.maps.normals[0],
        }[name]
        filled = self._filled(self._edges.filled(maps))
        return lambda pixels, *where: _by_pixel(read(filled, pixels, *where))

    def change(self, shadow: CastShadow, rows: slice, columns: slice) -> np.ndarray:
        """Factor [h, w] of a light's image by the shadow that it casts."""
        grid = self._grid(rows, columns)
        return np.asarray(change(CastShadow(*(_enlarged(maps, grid) for maps in shadow))).numpy())

    def exposure_ev(self, lit: Tensor, own: Tensor, rule: ExposureRule) -> float:
        """The exposure in EV, by a rule, of the person under the light of maps [15, S, S] and its own [3]."""
        view = self._view
        (relit,) = view.relit(PortraitLight.of(lit[None]))
        relit = relit + own[:, None, None] * view.person.image
        skin = view.person.classes[class_index("skin")].numpy()
        image = view.person.image.permute(1, 2, 0).numpy()
        return chosen_exposure_ev(rule, _by_pixel(relit), image, skin, self.own.numpy())

    def _albedo(self, pixels: np.ndarray, wide: Tensor, display_ev: float) -> Tensor:
        """The photo without its light [3, h, w], from the maps over its pixels [h, w, 3]."""
        lit = torch.from_numpy(pixels).permute(2, 0, 1) / self._view.person.exposure
        return lit * self._gain(pixels, wide, display_ev) + wide[12:_ALBEDO_MAPS]

    def _gain(self, pixels: np.ndarray, wide: Tensor, display_ev: float) -> Tensor:
        """The gain [3, h, w], from the maps over the photo's pixels [h, w, 3]."""
        guide = torch.from_numpy(to_display(pixels, display_ev)).permute(2, 0, 1).float() / 255
        slopes, offset = torch.split(wide[:12], [9, 3])
        log_gain = (slopes.view(3, 3, *guide.shape[1:]) * guide).sum(1) + offset
        return log_gain.clamp(*self._gain_range).exp()

    def _gain_lines(self) -> Tensor:
        """Log of the gain as a linear function of the photo's colours: slopes and offsets [12, S, S]."""
        log_gain = self._filled(self._view.maps.gain[0].log())
        self._gain_range = float(log_gain.min()), float(log_gain.max())
        guide = to_display(self._view.person.image.permute(1, 2, 0).numpy()).astype(np.float32) / 255
        lines = [local_lines(channel.numpy(), guide, _REACH_PX, _SMOOTHNESS) for channel in log_gain]
        slopes = np.concatenate([slope.transpose(2, 0, 1) for slope, _ in lines])
        return torch.from_numpy(np.concatenate([slopes, np.stack([offset for _, offset in lines])])).float()

    def _smooth(self, light: Tensor) -> Tensor:
        """Shading and highlights [6, S, S], continued over the background; highlights are blurred."""
        shading, highlights = torch.chunk(self._filled(light), 2)
        return self._filled(self._edges.filled(torch.cat([shading, blurred(highlights, _GLOSS_PX)])))

    def _filled(self, maps: Tensor) -> Tensor:
        """Maps [C, S, S] with the person's values continued over the background."""
        return inpaint(maps, self.own)

    def _places_alike(self, where: tuple[slice, slice], pixels: np.ndarray) -> Tensor:
        """Places [h, w, 2] in the maps where pixels [h, w, 3] in rows and columns find their like."""
        grid, unit = self._grid(*where), self._view.person.exposure
        return places(self._colours, self._trust, grid, torch.from_numpy(pixels), unit)

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
