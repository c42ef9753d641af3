"""Relit people of one photo, laid over each other in its frame."""

from collections.abc import Iterator, Sequence

import numpy as np

from facerf_cli.image.colour import ExposureRule
from facerf_cli.image.strips import Band, Layer, by_rows
from facerf_cli.light.studio_points import Lights
from facerf_cli.relighting.composition import Composition, Relit
from facerf_cli.relighting.whole_person import COLOURS

Group = Sequence[Relit]  # of each person, in the order of the compositions
_PERSON_MATTE = "person.A"


class GroupComposition:
    """Compose relit people of one photo, each by a composition of its own; the first is the nearest."""

    def __init__(self, compositions: Sequence[Composition]) -> None:
        self._first, *self._others = compositions
        self.size_px = self._first.size_px
        self.nbytes = sum(one.nbytes for one in compositions)

    def relit(self, lights: Sequence[Lights]) -> Iterator[Group]:
        """The people, each under each of the sums of its own lights."""
        people = zip((self._first, *self._others), lights, strict=True)
        return zip(*(one.relit(own) for one, own in people), strict=True)

    def bands(self, relit: Group, ev: float, behind: Band | None) -> dict[str, Layer]:
        """The people in the photo's frame; see `Composition.bands`."""
        if behind is None and self._first.keeps_photo:
            plate, people = self._plate(2.0**-ev), self.light_layer(relit)
            return {"rgb": lambda rows: (plate(rows) + people(rows)).clip(min=0)}
        first = self._first.bands(relit[0], ev, behind)
        pixels, alpha = by_rows(first["rgb"]), first.get("A")
        for person, share in self._people(relit):
            if alpha is None:
                pixels = _over(person, share, pixels)
                continue
            whole = _over(_ones, share, by_rows(alpha))
            both = _over(person, share, _times(pixels, by_rows(alpha)))
            pixels, alpha = _straight(both, whole), whole
        return {"rgb": pixels} if alpha is None else {"rgb": pixels, "A": alpha}

    def _plate(self, gain: float) -> Band:
        """The photo [H, W, 3] without its people, shown at a gain."""
        photo, people = self._first.photo, self._first.own_layer(straight=False)
        for other in self._others:
            people = _over(other.own_layer(straight=True), other.share_in_photo, people)
        return lambda rows: (photo[rows] - people(rows)) * np.float32(gain)

    def light_layer(self, relit: Group) -> Band:
        """The people [H, W, 3] under one of several lights, over black."""
        layer = self._first.light_layer(relit[0])
        for person, share in self._people(relit):
            layer = _over(person, share, layer)
        return layer

    def layers(self, names: Sequence[str], relit: Group) -> dict[str, Layer]:
        """Layers by the names that they have in a file; positions are in each person's own camera.

        Shares and colours are laid over each other; other layers are those of who shows most in a pixel.
        """
        found = self._first.layers(names, relit[0])
        for composition, one, (_, share) in zip(self._others, relit[1:], self._people(relit), strict=True):
            alpha = by_rows(found[_PERSON_MATTE])
            for name, layer in composition.layers(names, one).items():
                own, below = by_rows(layer), by_rows(found[name])
                adds = name in COLOURS or name.endswith(".A") or name.startswith("class.")
                found[name] = _added(own, share, below) if adds else _chosen(own, share, below, alpha)
        return found

    def exposure_ev(self, relit: Group, rule: ExposureRule) -> float:
        """The exposure in EV of the first person, by a rule."""
        return self._first.exposure_ev(relit[0], rule)

    def _people(self, relit: Group) -> Iterator[tuple[Band, Band]]:
        for composition, one in zip(self._others, relit[1:], strict=True):
            yield composition.person_and_share(one)


def _over(top: Band, share: Band, below: Band) -> Band:
    def of(rows: slice) -> np.ndarray:
        under, weight = below(rows), share(rows)
        if not weight.any():  # most rows of a crowd
            return under
        weight = weight[..., None] if under.ndim == 3 else weight
        return np.asarray(under + weight * (top(rows) - under))

    return of


def _added(top: Band, share: Band, below: Band) -> Band:
    def of(rows: slice) -> np.ndarray:
        under, left = below(rows), 1 - share(rows)
        return np.asarray(top(rows) + (left[..., None] if under.ndim == 3 else left) * under)

    return of


def _chosen(top: Band, share: Band, below: Band, alpha: Band) -> Band:
    """Values [H, W, C] of what shows more in a pixel."""

    def of(rows: slice) -> np.ndarray:
        under, weight = below(rows), share(rows)
        if not weight.any():
            return under
        return np.where((weight > (1 - weight) * alpha(rows))[..., None], top(rows), under)

    return of


def _ones(rows: slice) -> np.ndarray:
    return np.ones((), np.float32)


def _times(pixels: Band, alpha: Band) -> Band:
    return lambda rows: pixels(rows) * alpha(rows)[..., None]


def _straight(pixels: Band, alpha: Band) -> Band:
    """Colours before they were multiplied by alpha."""
    return lambda rows: pixels(rows) / np.maximum(alpha(rows), 1e-6)[..., None]
