"""Several people of one photo in one relit image: the first one's, with the others over it."""

from collections.abc import Iterator, Sequence

import numpy as np

from facerf_cli.colour import ExposureRule
from facerf_cli.composite import Composition, Relit, RelitRows
from facerf_cli.strips import Computed, Rows

Group = Sequence[Relit]  # of each person, in the order of the compositions
_PERSON_MATTE = "person.A"


class GroupComposition:
    """Compose relit people of one photo, each by a composition of its own; the first is the nearest."""

    def __init__(self, compositions: Sequence[Composition]) -> None:
        self._first, *self._others = compositions

    def rows(self, relit: Group, ev: float, behind: Rows | None) -> RelitRows:
        """The people in the photo's frame; see `Composition.rows`."""
        shown = self._first.rows(relit[0], ev, behind)
        pixels, alpha = shown.pixels, shown.alpha
        for person, share in self._people(relit):
            if alpha is None:
                pixels = _over(person, share, pixels)
                continue
            whole = _over(_ones(alpha), share, alpha)
            both = _over(person, share, _times(pixels, alpha))
            pixels, alpha = _straight(both, whole), whole
        return RelitRows(pixels, alpha)

    def light_layer(self, relit: Group) -> Rows:
        """The people [H, W, 3] under one of several lights, over black."""
        layer = self._first.light_layer(relit[0])
        for person, share in self._people(relit):
            layer = _over(person, share, layer)
        return layer

    def layers(self, names: Sequence[str], relit: Group) -> dict[str, Rows]:
        """Layers by the names that they have in a file; positions are in each person's own camera."""
        found = self._first.layers(names, relit[0])
        for composition, one, (_, share) in zip(self._others, relit[1:], self._people(relit), strict=True):
            for name, layer in composition.layers(names, one).items():
                own = _ones(layer) if name == _PERSON_MATTE else layer
                found[name] = _over(own, share, found[name])
        return found

    def exposure_ev(self, relit: Group, rule: ExposureRule) -> float:
        """The exposure in EV of the first person, by a rule."""
        return self._first.exposure_ev(relit[0], rule)

    def _people(self, relit: Group) -> Iterator[tuple[Rows, Rows]]:
        for composition, one in zip(self._others, relit[1:], strict=True):
            yield composition.person(one)


def _over(top: Rows, share: Rows, below: Rows) -> Rows:
    def of(rows: slice) -> np.ndarray:
        weight = share[rows][..., None] if len(below.shape) == 3 else share[rows]
        return np.asarray(below[rows] + weight * (top[rows] - below[rows]))

    return Computed(below.shape, of)


def _ones(like: Rows) -> Rows:
    return np.broadcast_to(np.float32(1), like.shape)


def _times(pixels: Rows, alpha: Rows) -> Rows:
    return Computed(pixels.shape, lambda rows: pixels[rows] * alpha[rows][..., None])


def _straight(pixels: Rows, alpha: Rows) -> Rows:
    """Colours before they were multiplied by alpha."""
    return Computed(pixels.shape, lambda rows: pixels[rows] / np.maximum(alpha[rows], 1e-6)[..., None])
