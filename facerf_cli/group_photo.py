"""Several people of one photo in one relit image: the first one's, with the others over it."""

from collections.abc import Iterator, Sequence

import numpy as np

from facerf_cli.colour import ExposureRule
from facerf_cli.composite import Composition, Relit, RelitImage

Group = Sequence[Relit]  # of each person, in the order of the compositions
_PERSON_MATTE = "person.A"


class GroupComposition:
    """Compose relit people of one photo, each by a composition of its own; the first is the nearest."""

    def __init__(self, compositions: Sequence[Composition]) -> None:
        self._first, *self._others = compositions

    def image(self, relit: Group, ev: float, behind: np.ndarray | None) -> RelitImage:
        """The people in the photo's frame; see `Composition.image`."""
        shown = self._first.image(relit[0], ev, behind)
        pixels, alpha = shown.pixels, shown.alpha
        for person, share in self._people(relit):
            if alpha is None:
                pixels = _over(person, share, pixels)
                continue
            whole = _over(np.ones_like(alpha), share, alpha)
            both = _over(person, share, pixels * alpha[..., None])
            pixels, alpha = both / np.maximum(whole, 1e-6)[..., None], whole
        return RelitImage(pixels, alpha)

    def light_layer(self, relit: Group) -> np.ndarray:
        """The people [H, W, 3] under one of several lights, over black."""
        layer = self._first.light_layer(relit[0])
        for person, share in self._people(relit):
            layer = _over(person, share, layer)
        return layer

    def layers(self, names: Sequence[str], relit: Group) -> dict[str, np.ndarray]:
        """Layers by the names that they have in a file; positions are in each person's own camera."""
        found = self._first.layers(names, relit[0])
        for composition, one, (_, share) in zip(self._others, relit[1:], self._people(relit), strict=True):
            for name, layer in composition.layers(names, one).items():
                own = np.ones_like(layer) if name == _PERSON_MATTE else layer
                found[name] = _over(own, share, found[name])
        return found

    def exposure_ev(self, relit: Group, rule: ExposureRule) -> float:
        """The exposure in EV of the first person, by a rule."""
        return self._first.exposure_ev(relit[0], rule)

    def _people(self, relit: Group) -> Iterator[tuple[np.ndarray, np.ndarray]]:
        for composition, one in zip(self._others, relit[1:], strict=True):
            yield composition.person(one)


def _over(top: np.ndarray, share: np.ndarray, below: np.ndarray) -> np.ndarray:
    weight = share[..., None] if below.ndim == 3 else share
    return np.asarray(below + weight * (top - below))
