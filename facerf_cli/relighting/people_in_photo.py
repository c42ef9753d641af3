"""People of one photo, relit, laid over each other in its frame; mostly it is one person.

Before the photo's own background the image is the photo, without its people as photographed, and the relit
people over it. So edges come back exactly, and layers of lights add up.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from typing import Any, Literal

import numpy as np

from facerf_cli.image.colour import ExposureRule
from facerf_cli.image.strips import Window, in_strips
from facerf_cli.light.light import Light
from facerf_cli.relighting.face_alone import FaceInPhoto
from facerf_cli.relighting.person_in_photo import COLOURS, PersonInPhoto
from facerf_cli.relighting.relightable import Relightable, Relit, RenderRequest

Background = Literal["photo", "none", "given"]
Shares = Sequence[np.ndarray]  # [h, W, 1] of people, the nearest first
_BLACK, _TINY = np.float32(0), 1e-6


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

    def relit(self, lights: Light | Sequence[Light]) -> Iterator[tuple[Relit, ...]]:
        """Relight the people by each sum of lights, which may be those of each person."""
        each = [lights] * len(self.people) if isinstance(lights, Light) else lights
        return zip(*(person.relit(own) for person, own in zip(self.people, each, strict=True)), strict=True)

    def exposure_ev(self, relit: Sequence[Relit], rule: ExposureRule) -> float:
        """The exposure in EV of the first person, by a rule."""
        return self.people[0].exposure_ev(relit[0], rule)

    def renderer(self, request: RenderRequest) -> Callable[[slice], dict[str, np.ndarray]]:
        """What gives rows of the image, of the people under lights over black, and of layers.

        Positions are in each person's own camera.
        """
        lights = [] if request.image is None else [(request.image, request.layers)]
        lights += [(relit, ()) for relit in request.lights.values()]
        ready = [
            [person.ready(relit[number], layers) for relit, layers in lights]
            for number, person in enumerate(self.people)
        ]
        return partial(self._render, request, ready)

    def own_layer(self) -> np.ndarray:
        """The people [H, W, 3] as photographed, over black."""
        return in_strips(self._as_photographed, *self.size_px)["own"]

    def _render(
        self, request: RenderRequest, ready: Sequence[Sequence[Any]], rows: slice
    ) -> dict[str, np.ndarray]:
        window, (numbers, shares) = Window(rows, slice(0, self.size_px[1])), self._present(rows)
        owns = [self.people[number].own[rows] for number in numbers]
        images = [
            self.people[number].render(window, own, ready[number])
            for number, own in zip(numbers, owns, strict=True)
        ]
        under_each, found = zip(*images, strict=True), dict[str, np.ndarray]()
        if request.image is not None:
            each = next(under_each)
            pixels = _with_own_light(each, [request.image[number] for number in numbers], owns)
            found["rgb"] = self._image(request, shares, owns, pixels, rows)
            found |= _layers(shares, each)
        for (name, relit), each in zip(request.lights.items(), under_each, strict=True):
            found[name] = _over(shares, _with_own_light(each, [relit[number] for number in numbers], owns))
        return request.wrapped(found, rows)

    def _present(self, rows: slice) -> tuple[list[int], Shares]:
        """Numbers of the people in some rows, of a crowd few, and the share [h, W, 1] of each.

        All of the first is relit.
        """
        numbers, shares = [0], [self.people[0].matte[rows][..., None]]
        for number, person in enumerate(self.people[1:], 1):
            if (share := person.share(rows)).any():
                numbers.append(number)
                shares.append(share[..., None])
        return numbers, shares

    def _shares(self, rows: slice) -> dict[str, np.ndarray]:
        return {"alpha": _alpha(self._present(rows)[1])[..., 0]}

    def _as_photographed(self, rows: slice) -> dict[str, np.ndarray]:
        numbers, shares = self._present(rows)
        return {"own": _over(shares, [self.people[number].own[rows] for number in numbers])}

    def _image(
        self,
        request: RenderRequest,
        shares: Shares,
        owns: Sequence[np.ndarray],
        pixels: Sequence[np.ndarray],
        rows: slice,
    ) -> np.ndarray:
        """Pixels [h, W, 3] of the people before what is behind them."""
        if request.background is not None:
            return _over(shares, pixels, request.background[rows])
        if self.keeps_photo:
            plate = (self.people[0].photo[rows] - _over(shares, owns)) * np.float32(2.0**-request.ev)
            found = plate + _over(shares, pixels)
            return found.clip(min=0) if len(self.people) > 1 else found
        if len(shares) == 1:
            return pixels[0]
        return _over(shares, pixels) / np.maximum(_alpha(shares), _TINY)  # not multiplied by alpha


def _with_own_light(
    images: Sequence[dict[str, np.ndarray]], relit: Sequence[Relit], owns: Sequence[np.ndarray]
) -> list[np.ndarray]:
    """Pixels [h, W, 3] of people, with the share of the photo's own light, in which they have `owns`."""
    found = []
    for image, one, own in zip(images, relit, owns, strict=True):
        pixels = image["rgb"]
        if one.own is not None and one.own.any():
            pixels = pixels + one.own.detach().numpy() * own
        found.append(pixels)
    return found


def _over(shares: Shares, pixels: Sequence[np.ndarray], below: Any = _BLACK) -> np.ndarray:
    """People, the nearest first, with pixels [h, W, 3] of each, laid over what is below, by default black."""
    for share, own in zip(shares, pixels, strict=True):
        below = below + share * (own - below)
    return np.asarray(below)


def _alpha(shares: Shares) -> np.ndarray:
    """Share [h, W, 1] of all people."""
    found: Any = _BLACK
    for share in shares:
        found = found + share * (1 - found)
    return np.asarray(found)


def _layers(shares: Shares, each: Sequence[dict[str, np.ndarray]]) -> dict[str, np.ndarray]:
    """Layers of all people: shares and colours are laid over each other; others are of who shows most."""
    found: dict[str, np.ndarray] = {}
    alpha: Any = _BLACK
    for share, layers in zip(shares, each, strict=True):
        for name, top in layers.items():
            if name == "rgb":
                continue
            if name not in found:
                found[name] = top
            elif name in COLOURS or name.endswith(".A") or name.startswith("class."):
                found[name] = top + (1 - (share if top.ndim == 3 else share[..., 0])) * found[name]
            else:
                found[name] = np.where(share > (1 - share) * alpha, top, found[name])
        alpha = alpha + share * (1 - alpha)
    return found
