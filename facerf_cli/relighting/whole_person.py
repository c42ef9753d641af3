"""The whole person of a portrait field, relit at the photo's own resolution.

Of its views the narrower lies over the wider one, and fades toward its border.
"""

from collections.abc import Sequence
from functools import cached_property

import numpy as np
from torch import Tensor

from facerf_cli.image.colour import ExposureRule
from facerf_cli.image.strips import Band, Layer
from facerf_cli.portrait.matte import PersonColours
from facerf_cli.portrait.parse import uncovered_rows
from facerf_cli.relighting.cast_shadows import CastShadow
from facerf_cli.relighting.enlarged import Enlarged, Shown
from facerf_cli.relighting.eyes import Eyes
from facerf_cli.relighting.grain import Grain
from facerf_cli.relighting.portrait_field import PortraitField
from facerf_cli.relighting.rims import Rims
from facerf_cli.relighting.surface import Surface

COLOURS = ("albedo", "specular")  # layers that are radiance
_NO_GRAIN = ("hair", "eyes", "lips", "mouth")  # its blur would mix their colours with the skin's
_LEAST_MOUTH = 0.12  # share of lips and mouth in a pixel from which on it has none
_LEAST = 0.02  # share of the person in a pixel that has layers: the matte's tail is noise


class WholePerson:
    """A photo's person under sums of lights, given by their maps [views, 15, S, S]."""

    def __init__(self, photo: np.ndarray, field: PortraitField) -> None:
        segmentation = field.person.segmentation
        self.matte = segmentation.matte
        self.bare_face = uncovered_rows(segmentation.classes, (photo.shape[0], photo.shape[1]))
        self._segmentation, self._size_px = segmentation, photo.shape[:2]
        self._person = field.person
        self._views = [Enlarged(view, photo) for view in field.views]

    @property
    def nbytes(self) -> int:
        """Size of one light's maps."""
        return sum(15 * view.own.nbytes for view in self._views)

    def over_photo(self, photo: np.ndarray | PersonColours, lit: Tensor, display_ev: float) -> Band:
        """The photo's pixels, by rows, under the light of maps [views, 15, S, S].

        [H, W, 3] under light that does not come from behind; with such light [H, W, 6], its part the last
        three. `display_ev` is the exposure at which the photo is shown to the guided filter.
        """
        rims = self._rims if lit[:, 9:].any() else None
        relit = [view.relit(one, display_ev, rims) for view, one in zip(self._views, lit, strict=True)]
        return self._joined(photo, relit)

    def change(self, shadow: CastShadow, rows: slice) -> np.ndarray:
        """Factor [h, W, 1] of a light's image in some rows, by its shadow in the narrower view."""
        columns, weight = self._views[0].weight(rows)
        factor = np.ones((len(weight), self._size_px[1], 1), np.float32)
        if weight.any():
            factor[:, columns, 0] += weight * (self._views[0].change(shadow, rows, columns) - 1)
        return factor

    @cached_property
    def _rims(self) -> Rims:
        return Rims(self.matte, self._person.square.side_px / self._person.sides)

    def finish(
        self, photo: np.ndarray | PersonColours, display_ev: float, matte: np.ndarray
    ) -> tuple[Grain, Eyes]:
        """The detail of the photo [H, W, 3] without its light, for a person's matte [H, W]; and the eyes."""
        flat = self._joined(photo, [view.without_light(display_ev) for view in self._views])
        hair, eyes, lips, mouth = (self._segmentation.layer(name) for name in _NO_GRAIN)
        plain = (1 - hair - eyes).clip(0) * (1 - (lips + mouth) / _LEAST_MOUTH).clip(0)
        sharpened = self._joined(photo, [view.sharpened for view in self._views])
        grain = Grain(flat, (matte > 0) * plain, self._views[0].pixel_px, sharpened)
        return grain, Eyes(photo.__getitem__, self._person.eyes, self._size_px)

    def exposure_ev(self, lit: Tensor, own: Tensor, rule: ExposureRule) -> float:
        """The exposure in EV, by a rule, of the person under the light of maps [views, 15, S, S].

        The photo's own light has the share `own` [3].
        """
        return self._views[0].exposure_ev(lit[0], own, rule)

    def layer(
        self, name: str, lit: Tensor, photo: np.ndarray | PersonColours, matte: np.ndarray
    ) -> dict[str, Layer]:
        """A layer of the photo's pixels [H, W, 3] under maps of light, by the names that it has in a file.

        albedo: radiance of the person in a light of rgb 1 that reaches all; specular: that of the highlights;
        shadow: the share of the light that arrives; normal and position: camera space, m; depth: m; classes:
        shares. All are 0 off the person, whose share is the `matte` [H, W]: colours are multiplied by it, as
        layers of lights are.
        """
        if name == "classes":
            return {**self._segmentation.layers()}
        if name in ("position", "depth"):
            shown = getattr(self._surface, f"{name}_m")
        else:
            views = [view.layer(name, one) for view, one in zip(self._views, lit, strict=True)]
            shown = self._joined(photo, views)

        def of(rows: slice) -> np.ndarray:
            share = matte[rows][..., None]
            wide = shown(rows) * (share if name in COLOURS else share > _LEAST)
            if name == "normal":
                wide = wide / np.maximum(np.linalg.norm(wide, axis=-1, keepdims=True), 1e-6)
            return wide

        return {name: of}

    @cached_property
    def _surface(self) -> Surface:
        return Surface(self._person, self._size_px)

    def _joined(self, photo: np.ndarray | PersonColours, views: Sequence[Shown]) -> Band:
        """An image or layer [H, W, C], by rows, of what each view shows; the widest lies below."""

        def of(rows: slice) -> np.ndarray:
            pixels = photo[rows].clip(min=0)
            found = views[-1](pixels, rows, slice(0, pixels.shape[1]))
            for view, shown in reversed(list(zip(self._views, views, strict=True))[:-1]):
                columns, weight = view.weight(rows)
                if weight.any():
                    part = found[:, columns]
                    part += weight[..., None] * (shown(pixels[:, columns], rows, columns) - part)
            return found

        return of
