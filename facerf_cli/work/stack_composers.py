"""Composers of OLAT stacks: sums of their lights as images, alone or back on the photo."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from facerf_cli.errors import UsageError
from facerf_cli.files.olat_stack import StackHeader
from facerf_cli.image.colour import ExposureRule, anchored_exposure_ev, auto_exposure_ev
from facerf_cli.image.resample import resized_rows
from facerf_cli.image.strips import Band, Layer
from facerf_cli.relighting.composite import Relit

_DARK = 1e-3  # keeps a change of light finite, as a share of the photo's mean


@dataclass(frozen=True, eq=False)
class RenderedStack:
    """Composes stacks of images that are rendered already; seen [H, W] is the face's coverage."""

    seen: np.ndarray
    normals: np.ndarray  # [H, W, 3]

    @property
    def size_px(self) -> tuple[int, int]:
        """Height and width of the images."""
        return self.seen.shape[0], self.seen.shape[1]

    def bands(self, relit: Relit, ev: float, behind: Band | None) -> dict[str, Layer]:
        """The face as relit, with its coverage as alpha."""
        pixels = _pixels(relit)
        return {"rgb": pixels, "A": self.seen}

    def light_layer(self, relit: Relit) -> Band:
        """The face under one of several lights, over black."""
        pixels = _pixels(relit)
        return lambda rows: pixels[rows] * self.seen[rows][..., None]

    def layers(self, names: Sequence[str], relit: Relit) -> dict[str, Layer]:
        """The layer of normals; raises UsageError for others."""
        return _only_normals(names, self.normals)

    def exposure_ev(self, relit: Relit, rule: ExposureRule) -> float:
        """The exposure that shows the face well, whatever the rule: there is no photo to compare with."""
        return auto_exposure_ev(_pixels(relit), self.seen)


@dataclass(frozen=True, eq=False)
class PersonStack:
    """Composes stacks of a photo's person over black, alone, or with `photo` [H, W, 3] in that photo.

    The photo may be larger than the stack: then the change of light is enlarged, and the photo keeps its
    detail. `keeps_background` shows the photo's own.
    """

    header: StackHeader
    face: np.ndarray  # [H, W] coverage, by which the exposure is chosen
    photo: np.ndarray | None = None
    keeps_background: bool = True

    @property
    def size_px(self) -> tuple[int, int]:
        """Height and width of the frame."""
        height, width = (self.header.seen if self.photo is None else self.photo).shape[:2]
        return height, width

    def bands(self, relit: Relit, ev: float, behind: Band | None) -> dict[str, Layer]:
        """The person before the photo's background at `ev`, before another, or with alpha."""
        (person, matte), photo, gain = self._person(relit), self.photo, np.float32(2.0**-ev)
        if photo is None or (behind is None and not self.keeps_background):
            return {"rgb": person, "A": matte}

        def of(rows: slice) -> np.ndarray:
            below = behind(rows) if behind else gain * photo[rows]
            return np.asarray(below + matte(rows)[..., None] * (person(rows) - below))

        return {"rgb": of}

    def light_layer(self, relit: Relit) -> Band:
        """The person under one of several lights, over black."""
        person, matte = self._person(relit)
        return lambda rows: person(rows) * matte(rows)[..., None]

    def layers(self, names: Sequence[str], relit: Relit) -> dict[str, Layer]:
        """The matte and the layer of normals; raises UsageError for others."""
        normals = resized_rows(self.header.normals, self.size_px)
        return {"person.A": self._matte()} | _only_normals(names, normals)

    def exposure_ev(self, relit: Relit, rule: ExposureRule) -> float:
        """The exposure in EV of the person, by a rule."""
        person, seen = _straight(_pixels(relit), self.header.seen), self.header.seen
        if rule == "face":
            return auto_exposure_ev(person, seen)
        return anchored_exposure_ev(person, self.header.source, self.face * seen, seen)

    def _person(self, relit: Relit) -> tuple[Band, Band]:
        """The person's own colours [H, W, 3], and its matte [H, W]."""
        own, photo, seen = _straight(_pixels(relit), self.header.seen), self.photo, self.header.seen
        if photo is None or self.size_px == seen.shape:
            return lambda rows: own[rows], lambda rows: seen[rows]
        source = self.header.source
        change = resized_rows(own / (source + _DARK * source.mean()), self.size_px)
        return lambda rows: photo[rows] * change(rows), self._matte()

    def _matte(self) -> Band:
        return resized_rows(self.header.seen, self.size_px)


def _pixels(relit: Relit) -> np.ndarray:
    return np.asarray(relit.texture.permute(1, 2, 0).numpy())


def _straight(over_black: np.ndarray, matte: np.ndarray) -> np.ndarray:
    """Colours before they were multiplied by the matte; 0 where it is."""
    share = matte[..., None]
    return np.divide(over_black, share, out=np.zeros_like(over_black), where=share > 1e-3)


def _only_normals(names: Sequence[str], normals: Layer) -> dict[str, Layer]:
    if other := [name for name in names if name != "normal"]:
        raise UsageError(f"--aov {other[0]}: a stack of images holds normals alone; give --aov normal")
    return {"normal": normals} if names else {}
