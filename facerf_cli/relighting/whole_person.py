"""The whole person of a portrait field, relit at the photo's own resolution.

The field's maps are coarse. Its gain is enlarged with the photo as a guide, so that the photo without its
light keeps every pore and hair; shading and highlights of a light are smooth and enlarged as they are.
"""

from functools import cached_property

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from facerf_cli.face.landmarks import display_ev, to_display
from facerf_cli.image.colour import ExposureRule, chosen_exposure_ev
from facerf_cli.image.strips import Band, Layer
from facerf_cli.portrait.classes import class_index
from facerf_cli.portrait.matte import PersonColours, local_lines
from facerf_cli.portrait.parse import uncovered_rows
from facerf_cli.raster.camera import PIXEL_CENTRE
from facerf_cli.raster.texture import blurred, inpaint
from facerf_cli.relighting.portrait_field import PortraitField

_REACH_PX, _SMOOTHNESS = 2, 1e-3  # of the guided filter, in pixels of the square, and variance of its guide
_ALBEDO_MAPS = 15  # slopes and offsets of the gain, and the bias
_FEATHER = 0.12  # border of the square where the change of light takes over, in halves of its side
_CHANGE_PX, _DARK = 14.0, 1e-3  # of that change: its blur, and what keeps it finite, as a share of the photo
_GLOSS_PX = 0.8  # blur of highlights, which the network draws in pairs of pixels
_STRAND_RANGE = (0.3, 3.0)  # of an albedo over that of the maps: strands of hair break up its highlights
_SURE = 0.5  # share of the person from which on a pixel of the maps is its own


class WholePerson:
    """A photo's person under sums of lights; outside the square the change of light at its border goes on."""

    def __init__(self, photo: np.ndarray, field: PortraitField) -> None:
        self.matte = field.person.segmentation.matte
        size_px = (photo.shape[0], photo.shape[1])
        self.bare_face = uncovered_rows(field.person.segmentation.classes, size_px)
        self._field, self._photo = field, photo
        self._display_ev = display_ev(photo)
        self.own = (1 - field.person.classes[0] > _SURE).float()
        hair = field.person.classes[[class_index("hair"), class_index("beard")]].sum(0, keepdim=True)
        self.hair_maps = torch.cat([self._filled(field.maps.albedo[0].mean(0, keepdim=True)), hair])
        self.albedo_maps = torch.cat([self._gain_lines(), self._filled(field.maps.bias[0])])

    @property
    def nbytes(self) -> int:
        """Size of one light's maps."""
        return 3 * self._field.person.image.nbytes

    def over_photo(self, photo: np.ndarray | PersonColours, lit: Tensor, display_ev: float) -> Band:
        """The photo's pixels [H, W, 3], by rows, under shading and highlights, the first of maps [9, S, S].

        `display_ev` is the exposure at which the photo is shown to the guided filter.
        """
        highlights = blurred(self._filled(lit[3:6]), _GLOSS_PX)
        maps = [self.albedo_maps, self._filled(lit[:3]), highlights, self._change(lit), self.hair_maps]
        stacked = torch.cat(maps)

        def of(rows: slice) -> np.ndarray:
            pixels, (wide, inside) = photo[rows], self._enlarged(stacked, rows)
            shading, shine, change, hair = torch.split(wide[_ALBEDO_MAPS:], [3, 3, 3, 2])
            albedo = self._albedo(pixels, wide, display_ev)
            finer = (albedo.mean(0) / hair[0].clamp_min(1e-4)).clamp(*_STRAND_RANGE)
            shine = shine * torch.lerp(torch.ones_like(finer), finer, hair[1])
            radiance = (albedo * shading + shine) * self._field.exposure
            beyond = torch.from_numpy(pixels.clip(min=0)).permute(2, 0, 1) * change
            return torch.lerp(beyond, radiance, inside).permute(1, 2, 0).numpy()

        return of

    def _change(self, lit: Tensor) -> Tensor:
        """Smooth change of light [3, S, S] from the photo at the square's border, which goes on beyond it."""
        return self._of_border(self._relit(lit)) / self.own_change

    @cached_property
    def own_change(self) -> Tensor:
        """The photo's own part [3, S, S] of that change: its blur, and a little that keeps it from 0."""
        own = self._field.person.image
        return self._of_border(own) + _DARK * own.mean()

    def _of_border(self, maps: Tensor) -> Tensor:
        """Maps [C, S, S] of the person at the square's border alone, blurred, as they go on beyond it."""
        return blurred(inpaint(maps, self.at_border), _CHANGE_PX)

    @cached_property
    def at_border(self) -> Tensor:
        """The person [S, S] where the square is feathered; all of it where nobody is there."""
        side = self.own.shape[-1]
        width = round(_FEATHER * side / 2)
        inner = torch.zeros(side - 2 * width, side - 2 * width)
        found = self.own * F.pad(inner, (width,) * 4, value=1.0)
        return found if found.any() else self.own

    def exposure_ev(self, lit: Tensor, rule: ExposureRule) -> float:
        """The exposure in EV, by a rule, of the person under the light of maps [9, S, S]."""
        images = self._relit(lit), self._field.person.image
        relit, plate = (image.permute(1, 2, 0).numpy() for image in images)
        skin = self._field.person.classes[class_index("skin")].numpy()
        return chosen_exposure_ev(rule, relit, plate, skin, self.own.numpy())

    def _relit(self, lit: Tensor) -> Tensor:
        """The person in the square [3, S, S], as coarse as the maps."""
        return (self._field.maps.albedo[0] * lit[:3] + lit[3:6]) * self._field.exposure

    def layer(self, name: str, lit: Tensor) -> dict[str, Layer]:
        """A layer of an image under the light of maps [9, S, S], by the name or names that it has in a file.

        albedo: radiance of the person in a light of rgb 1 that reaches all; specular: that of the highlights;
        shadow: the share of the light that arrives; normal and position: camera space, m; depth: m; classes:
        shares. All are 0 off the person. Beyond the square what is at its border goes on, as the light does.
        """
        if name == "classes":
            return {**self._field.person.segmentation.layers()}
        if name == "albedo":
            return {name: self._masked(self._albedo_map)}
        person = self._field.person
        maps = {
            "specular": lit[3:6].clamp_min(0) * self._field.exposure,
            "shadow": lit[6:9],
            "normal": self._field.maps.normals[0],
            "position": person.maps.positions_m,
            "depth": -person.maps.positions_m[2:],
        }[name]
        filled = self._filled(maps)
        beyond = filled if name in ("position", "depth") else self._of_border(maps)
        both = torch.cat([beyond, filled])

        def of(rows: slice) -> np.ndarray:
            pair, inside = self._enlarged(both, rows)
            outer, inner = pair.chunk(2)
            wide: np.ndarray = torch.lerp(outer, inner, inside).permute(1, 2, 0).numpy()
            if name == "normal":
                wide = wide / np.maximum(np.linalg.norm(wide, axis=-1, keepdims=True), 1e-6)
            return wide

        return {name: self._masked(of)}

    def _masked(self, of: Band) -> Band:
        """A layer [H, W, C] without what lies off the person."""
        return lambda rows: of(rows) * (self.matte[rows] > 0)[..., None]

    def _albedo_map(self, rows: slice) -> np.ndarray:
        unlit = torch.zeros(6, *self.own.shape).index_fill_(0, torch.arange(3), 1.0)
        stacked, pixels = torch.cat([self.albedo_maps, self._change(unlit)]), self._photo[rows]
        wide, inside = self._enlarged(stacked, rows)
        found = self._albedo(pixels, wide, self._display_ev) * self._field.exposure
        beyond = torch.from_numpy(pixels.clip(min=0)).permute(2, 0, 1) * wide[_ALBEDO_MAPS:]
        return torch.lerp(beyond, found, inside).permute(1, 2, 0).numpy()

    def _albedo(self, photo: np.ndarray, wide: Tensor, exposure_ev: float) -> Tensor:
        """The photo without its light [3, h, W] in some rows [h, W, 3], from the maps over them."""
        pixels = torch.from_numpy(photo.clip(min=0)).permute(2, 0, 1)
        guide = torch.from_numpy(to_display(photo, exposure_ev)).permute(2, 0, 1).float() / 255
        slopes, offset, bias = torch.split(wide[:_ALBEDO_MAPS], [9, 3, 3])
        log_gain = (slopes.view(3, 3, *guide.shape[1:]) * guide).sum(1) + offset
        log_gain = log_gain.clamp(self.gain_range[0], self.gain_range[1])
        return pixels / self._field.person.exposure * log_gain.exp() + bias

    def _gain_lines(self) -> Tensor:
        """Log of the gain as a linear function of the photo's colours: slopes and offsets [12, S, S]."""
        log_gain = self._filled(self._field.maps.gain[0].log())
        self.gain_range = float(log_gain.min()), float(log_gain.max())
        guide = to_display(self._field.person.image.permute(1, 2, 0).numpy()).astype(np.float32) / 255
        lines = [local_lines(channel.numpy(), guide, _REACH_PX, _SMOOTHNESS) for channel in log_gain]
        slopes = np.concatenate([slope.transpose(2, 0, 1) for slope, _ in lines])
        return torch.from_numpy(np.concatenate([slopes, np.stack([offset for _, offset in lines])])).float()

    def _filled(self, maps: Tensor) -> Tensor:
        """Maps [C, S, S] with the person's values continued over the background."""
        return inpaint(maps, self.own)

    def _enlarged(self, maps: Tensor, rows: slice) -> tuple[Tensor, Tensor]:
        """Maps [C, h, W] over some rows of the photo, and the weight [h, W] of the square there."""
        height, width = self._photo.shape[:2]
        square = self._field.person.square
        x = 2 * (torch.arange(width) + PIXEL_CENTRE - square.x0_px) / square.side_px - 1
        y = 2 * (torch.arange(height)[rows] + PIXEL_CENTRE - square.y0_px) / square.side_px - 1
        grid = torch.stack([x.expand(len(y), -1), y[:, None].expand(-1, width)], -1)[None]
        wide = F.grid_sample(maps[None], grid.float(), padding_mode="border", align_corners=False)
        inside = ((1 - grid[0].abs().amax(-1)) / _FEATHER).clamp(0, 1)
        return wide[0], inside.float()
