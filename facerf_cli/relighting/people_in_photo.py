"""People of one photo, relit, laid over each other in its frame; mostly it is one person.

Before the photo's own background the image is the photo, without its people as photographed, and the relit
people over it. So edges come back exactly, and layers of lights add up.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Literal

import numpy as np

from facerf_cli.image.colour import ExposureRule
from facerf_cli.image.strips import in_strips
from facerf_cli.light.studio_points import Lights
from facerf_cli.relighting.face_in_photo import FaceInPhoto
from facerf_cli.relighting.person_in_photo import COLOURS, PersonInPhoto
from facerf_cli.relighting.relightable import Relightable, Relit, RenderRequest

Background = Literal["photo", "none", "given"]
_BLACK, _TINY = np.float32(0), 1e-6


@dataclass(frozen=True, eq=False)
class _Present:
    """One of the people in some rows, and the share [h, W, 1] of it."""

    number: int
    person: Any
    share: np.ndarray


@dataclass(frozen=True, eq=False)
class PeopleInPhoto(Relightable):
    """People of one photo, the nearest first, before the photo's background, nothing, or another image."""

    people: Sequence[PersonInPhoto | FaceInPhoto]
    background: Background = "photo"

    @property
    def size_px(self) -> tuple[int, int]:
        """Height and width of the photo."""
        return self.people[0].size_px

    @property
    def keeps_photo(self) -> bool:  # type: ignore[override]
        """True where the photo's own background stays behind the people."""
        return self.background == "photo"

    @property
    def nbytes(self) -> int:
        """Bytes of all people under one sum of lights."""
        return sum(person.nbytes for person in self.people)

    @cached_property
    def matte(self) -> np.ndarray:
        """Share [H, W] of the photo that is relit."""
        if len(self.people) == 1:
            return self.people[0].matte
        return in_strips(self._shares, *self.size_px)["alpha"]

    @property
    def person_matte(self) -> np.ndarray:
        """The same."""
        return self.matte

    def relit(self, lights: Lights | Sequence[Lights]) -> Iterator[tuple[Relit, ...]]:
        """Relight the people by each sum of lights, which may be those of each person."""
        each = [lights] * len(self.people) if isinstance(lights, Lights) else lights
        return zip(*(person.relit(own) for person, own in zip(self.people, each, strict=True)), strict=True)

    def ready(self, relit: Sequence[Relit], layers: Sequence[str] = ()) -> list[Any]:
        """Compute all that does not depend on rows, of each person."""
        return [person.ready(one, layers) for person, one in zip(self.people, relit, strict=True)]

    def exposure_ev(self, relit: Sequence[Relit], rule: ExposureRule) -> float:
        """The exposure in EV of the first person, by a rule."""
        return self.people[0].exposure_ev(relit[0], rule)

    def render(self, request: RenderRequest, rows: slice) -> dict[str, np.ndarray]:
        """Some rows of the image, of the people under lights over black, and of layers.

        Positions are in each person's own camera.
        """
        present = self._present(rows)
        seen = [one.person.observe(rows) for one in present]
        found: dict[str, np.ndarray] = {}
        if request.image is not None:
            found["rgb"] = self._image(request, present, seen, rows)
            for name in request.layers:
                found |= _layer(name, request.image, present, seen)
        for name, light in request.lights.items():
            found[name] = _over(present, _pixels(present, light, seen, rows))
        return found

    def own_layer(self) -> np.ndarray:
        """The people [H, W, 3] as photographed, over black."""
        return in_strips(self._as_photographed, *self.size_px)["own"]

    def _present(self, rows: slice) -> list[_Present]:
        """The people in some rows: the first, and of a crowd few others."""
        first, *others = self.people
        found = [_Present(0, first, first.matte[rows][..., None])]  # all that is relit
        for number, person in enumerate(others, 1):
            if (share := person.share(rows)).any():
                found.append(_Present(number, person, share[..., None]))
        return found

    def _shares(self, rows: slice) -> dict[str, np.ndarray]:
        return {"alpha": _alpha(self._present(rows))[..., 0]}

    def _as_photographed(self, rows: slice) -> dict[str, np.ndarray]:
        present = self._present(rows)
        return {"own": _over(present, _own(present, rows))}

    def _image(
        self, request: RenderRequest, present: Sequence[_Present], seen: Sequence[Any], rows: slice
    ) -> np.ndarray:
        pixels = _pixels(present, request.image, seen, rows)
        if request.background is not None:
            return _over(present, pixels, request.background[rows])
        if self.keeps_photo:
            own = _over(present, _own(present, rows))
            plate = (self.people[0].photo[rows] - own) * np.float32(2.0**-request.ev)
            found = plate + _over(present, pixels)
            return found.clip(min=0) if len(self.people) > 1 else found
        return _straight(present, pixels)


def _over(present: Sequence[_Present], pixels: Sequence[np.ndarray], below: Any = _BLACK) -> np.ndarray:
    """People, the nearest first, with pixels [h, W, 3] of each, laid over what is below, by default black."""
    for one, own in zip(present, pixels, strict=True):
        below = below + one.share * (own - below)
    return np.asarray(below)


def _straight(present: Sequence[_Present], pixels: Sequence[np.ndarray]) -> np.ndarray:
    """People over nothing, not multiplied by alpha."""
    if len(present) == 1:
        return pixels[0]
    return _over(present, pixels) / np.maximum(_alpha(present), _TINY)


def _alpha(present: Sequence[_Present]) -> np.ndarray:
    """Share [h, W, 1] of all people."""
    found: Any = _BLACK
    for one in present:
        found = found + one.share * (1 - found)
    return np.asarray(found)


def _own(present: Sequence[_Present], rows: slice) -> list[np.ndarray]:
    """Pixels [h, W, 3] of each of the people, as photographed."""
    return [one.person.own[rows] for one in present]


def _pixels(
    present: Sequence[_Present], relit: Sequence[Any], seen: Sequence[Any], rows: slice
) -> list[np.ndarray]:
    """Pixels [h, W, 3] of each of the people under one sum of lights, with the photo's own light."""
    found = []
    for one, of_one in zip(present, seen, strict=True):
        light = relit[one.number]
        pixels = one.person.pixels(light, of_one)
        if light.own is not None and light.own.any():
            pixels = pixels + light.own.detach().numpy() * one.person.own[rows]
        found.append(pixels)
    return found


def _layer(
    name: str, relit: Sequence[Any], present: Sequence[_Present], seen: Sequence[Any]
) -> dict[str, np.ndarray]:
    """A layer of all people: shares and colours are laid over each other; others are of who shows most."""
    found: dict[str, np.ndarray] = {}
    alpha: Any = _BLACK
    for one, of_one in zip(present, seen, strict=True):
        for key, top in one.person.layer(name, relit[one.number], of_one).items():
            if not one.number:
                found[key] = top
            elif key in COLOURS or key.endswith(".A") or key.startswith("class."):
                share = one.share if top.ndim == 3 else one.share[..., 0]
                found[key] = top + (1 - share) * found[key]
            else:
                found[key] = np.where(one.share > (1 - one.share) * alpha, top, found[key])
        alpha = alpha + one.share * (1 - alpha)
    return found
