"""Composers of OLAT stacks: sums of their lights as images, alone or back on the photo."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from facerf_cli.colour import ExposureRule, anchored_exposure_ev, auto_exposure_ev
from facerf_cli.composite import Relit, RelitRows
from facerf_cli.errors import UsageError
from facerf_cli.files.olat_stack import StackHeader
from facerf_cli.resize import resized_rows
from facerf_cli.strips import Computed, Rows

_DARK = 1e-3  # keeps a change of light finite, as a share of the photo's mean


@dataclass(frozen=True, eq=False)
class RenderedStack:
    """Composes stacks of images that are rendered already; seen [H, W] is the face's coverage."""

    seen: np.ndarray
    normals: np.ndarray  # [H, W, 3]

    def rows(self, relit: Relit, ev: float, behind: Rows | None) -> RelitRows:
        """The face as relit, with its coverage as alpha."""
        return RelitRows(_pixels(relit), self.seen)

    def light_layer(self, relit: Relit) -> np.ndarray:
        """The face under one of several lights, over black."""
        return np.asarray(_pixels(relit) * self.seen[..., None])

    def layers(self, names: Sequence[str], relit: Relit) -> dict[str, Rows]:
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

    def rows(self, relit: Relit, ev: float, behind: Rows | None) -> RelitRows:
        """The person before the photo's background at `ev`, before another, or with alpha."""
        (person, matte), photo, gain = self._person(relit), self.photo, np.float32(2.0**-ev)
        if behind is None:
            if photo is None or not self.keeps_background:
                return RelitRows(person, matte)
            behind = Computed(photo.shape, lambda rows: gain * photo[rows])
        shown = behind

        def of(rows: slice) -> np.ndarray:
            below = shown[rows]
            return np.asarray(below + matte[rows][..., None] * (person[rows] - below))

        return RelitRows(Computed(person.shape, of))

    def light_layer(self, relit: Relit) -> Rows:
        """The person under one of several lights, over black."""
        person, matte = self._person(relit)
        return Computed(person.shape, lambda rows: person[rows] * matte[rows][..., None])

    def layers(self, names: Sequence[str], relit: Relit) -> dict[str, Rows]:
        """The matte and the layer of normals; raises UsageError for others."""
        normals = resized_rows(self.header.normals, self._size())
        return {"person.A": self._matte()} | _only_normals(names, normals)

    def exposure_ev(self, relit: Relit, rule: ExposureRule) -> float:
        """The exposure in EV of the person, by a rule."""
        person, seen = _straight(_pixels(relit), self.header.seen), self.header.seen
        if rule == "face":
            return auto_exposure_ev(person, seen)
        return anchored_exposure_ev(person, self.header.source, self.face * seen, seen)

    def _person(self, relit: Relit) -> tuple[Rows, Rows]:
        """The person's own colours [H, W, 3], and its matte [H, W]."""
        own, photo = _straight(_pixels(relit), self.header.seen), self.photo
        if photo is None or self._size() == self.header.seen.shape:
            return own, self.header.seen
        source = self.header.source
        change = resized_rows(own / (source + _DARK * source.mean()), self._size())
        return Computed(photo.shape, lambda rows: photo[rows] * change[rows]), self._matte()

    def _matte(self) -> Rows:
        return resized_rows(self.header.seen, self._size())

    def _size(self) -> tuple[int, int]:
        height, width = (self.header.seen if self.photo is None else self.photo).shape[:2]
        return height, width


def _pixels(relit: Relit) -> np.ndarray:
    return np.asarray(relit.texture.permute(1, 2, 0).numpy())


def _straight(over_black: np.ndarray, matte: np.ndarray) -> np.ndarray:
    """Colours before they were multiplied by the matte; 0 where it is."""
    share = matte[..., None]
    return np.divide(over_black, share, out=np.zeros_like(over_black), where=share > 1e-3)


def _only_normals(names: Sequence[str], normals: Rows) -> dict[str, Rows]:
    if other := [name for name in names if name != "normal"]:
        raise UsageError(f"--aov {other[0]}: a stack of images holds normals alone; give --aov normal")
    return {"normal": normals} if names else {}
