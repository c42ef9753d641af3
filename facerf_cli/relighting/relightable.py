"""Interface of everything that can be relit: people in a photo, only a face, an OLAT stack.

A subject is relit at the resolution of its maps, for all sums of lights at once, and rendered at the
resolution of its frame in strips of rows. Both steps are linear in the light, so layers of single lights add
up.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import islice
from typing import Any

import numpy as np
from torch import Tensor

from facerf_cli.image.colour import ExposureRule
from facerf_cli.image.strips import Empty, Rows, in_strips, new_array
from facerf_cli.relighting.cast_shadows import CastShadow
from facerf_cli.relighting.portrait_field import PersonShading
from facerf_cli.run.memory import batches


@dataclass(frozen=True, eq=False)
class Relit:
    """Maps of a subject under one sum of lights, in linear radiance; only whole people have all of them."""

    texture: Tensor  # of the face [3, T, T]
    views: tuple[PersonShading, ...] = ()  # the person in each square
    eye_reflections: Tensor | None = None  # what the irises reflect [N, 3, s, s]
    mouth: Tensor | None = None  # the face [3, T, T] under the light that enters the mouth
    original_rgb: Tensor | None = None  # weight [3] of the photo's original light in the sum
    keys: "tuple[tuple[Relit, CastShadow], ...]" = ()  # each key light on its own, and the shadow it casts

    @property
    def tensors(self) -> list[Tensor]:
        """Texture and shading; images are linear in them."""
        return [self.texture, *(maps for view in self.views for maps in view.tensors)]


@dataclass(frozen=True, eq=False)
class RenderRequest:
    """What to render of a subject."""

    image: Any = None  # sum of lights for the image "rgb" [H, W, 3]; None: no image
    lights: Mapping[str, Any] = field(default_factory=dict)  # for layers [H, W, 3] over black, by name
    layers: Sequence[str] = ()  # names of other layers, under the image's light
    ev: float = 0.0  # exposure at which the photo's background keeps its look
    background: Rows | None = None  # image [H, W, 3] behind the subject; None: the photo, or nothing
    wrap: Rows | None = None  # light [H, W, 3] of the background, added to the image; layer "wrap"


class Relightable(ABC):
    """Subject that can be relit in a frame."""

    keeps_photo = False  # True if the photo's own background stays behind the subject

    @property
    @abstractmethod
    def size_px(self) -> tuple[int, int]:
        """Height and width of the frame."""

    @property
    @abstractmethod
    def matte(self) -> np.ndarray:
        """Alpha [H, W] of the part that is relit."""

    @property
    def person_matte(self) -> np.ndarray | None:
        """Matte that images contain as a layer; None for only a face."""
        return None

    @property
    @abstractmethod
    def nbytes(self) -> int:
        """Bytes of the subject under one sum of lights."""

    @abstractmethod
    def relit(self, lights: Any) -> Iterator[Any]:
        """Yield the subject under each of M sums of lights, from a single prediction."""

    @abstractmethod
    def renderer(self, request: RenderRequest) -> Callable[[slice], dict[str, np.ndarray]]:
        """Compute everything that does not depend on rows; return a function that renders rows [h, W, ...].

        Raises UsageError for layers that this subject lacks.
        """

    @abstractmethod
    def exposure_ev(self, relit: Any, rule: ExposureRule) -> float:
        """Return the exposure in EV that a rule chooses for the subject under one sum of lights."""

    def relit_images(self, lights_of: Callable[[slice], Any], sums: Sequence[int]) -> Iterator[list[Any]]:
        """Yield the relit subject for each image, as a list with one entry per sum of lights.

        `sums` is the number of sums for each image; `lights_of` returns the lights of a range of all sums. As
        many images as fit the memory share one prediction.
        """
        first = 0
        for part in self.parts(sums):
            last = first + sum(sums[part])
            relit = self.relit(lights_of(slice(first, last)))
            yield from ([*islice(relit, count)] for count in sums[part])
            first = last

    def parts(self, sums: Sequence[int]) -> list[slice]:
        """Return ranges of images that fit the memory together; `sums` as in `relit_images`."""
        return batches(len(sums), max(sums, default=1) * self.nbytes)

    def rendered(self, request: RenderRequest, empty: Empty = new_array) -> dict[str, np.ndarray]:
        """Render the whole frame, strip by strip, into arrays that `empty` allocates by name and shape."""
        return in_strips(self.renderer(request), *self.size_px, empty)

    def image(self, relit: Any) -> np.ndarray:
        """Render the image [H, W, 3] under one sum of lights, not premultiplied."""
        return self.rendered(RenderRequest(relit))["rgb"]

    def alpha(self, background: Rows | None = None) -> np.ndarray | None:
        """Return the matte if nothing is behind the subject, else None."""
        return self.matte if background is None and not self.keeps_photo else None

    def light_layer(self, relit: Any) -> np.ndarray:
        """Render the subject [H, W, 3] under one sum of lights over black."""
        return self.rendered(RenderRequest(lights={"": relit}))[""]
