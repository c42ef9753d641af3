"""The interface of all that can be relit: people in a photo, a face alone, an OLAT stack.

It is relit at the resolution of its maps, once for all sums of lights, and rendered at that of its
frame, some rows at a time. Both are linear in light: layers of single lights add up.
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
from facerf_cli.relighting.portrait_field import PortraitLight
from facerf_cli.run.memory import batches


@dataclass(frozen=True, eq=False)
class Relit:
    """A person under one sum of lights, at the resolution of its maps; linear radiance.

    Attributes:
        texture: The face [3, T, T].
        views: Of a `PersonInPhoto` its light in each square.
        mirrored: Of a `PersonInPhoto` what its eyes mirror [N, 3, s, s].
        mouth: Of a `PersonInPhoto` the face [3, T, T] in what falls into its mouth.
        own: Share [3] of the photo's own light, which joins the sum.
        keys: Of a `PersonInPhoto` key lights alone, and the shadow that each casts.
    """

    texture: Tensor
    views: tuple[PortraitLight, ...] = ()
    mirrored: Tensor | None = None
    mouth: Tensor | None = None
    own: Tensor | None = None
    keys: "tuple[tuple[Relit, CastShadow], ...]" = ()

    @property
    def tensors(self) -> list[Tensor]:
        """Texture and light of the views, in which images are linear."""
        return [self.texture, *(maps for view in self.views for maps in view.tensors)]


@dataclass(frozen=True, eq=False)
class RenderRequest:
    """Images and layers to render of a subject.

    Attributes:
        image: The sum of lights of the image "rgb" [H, W, 3]; None leaves the image out.
        lights: Sums of lights of layers [H, W, 3] over black, by name.
        layers: Names of further layers, under the image's light.
        ev: Exposure in EV at which the photo's background keeps its look.
        background: Image [H, W, 3] behind the subject; None: the photo, or nothing.
        wrap: Light [H, W, 3] of the background that is added to the image, and is its layer "wrap".
    """

    image: Any = None
    lights: Mapping[str, Any] = field(default_factory=dict)
    layers: Sequence[str] = ()
    ev: float = 0.0
    background: Rows | None = None
    wrap: Rows | None = None

    def wrapped(self, found: dict[str, np.ndarray], rows: slice) -> dict[str, np.ndarray]:
        """Arrays of some rows, with the background's light over the edge."""
        if self.wrap is not None and self.image is not None:
            found["wrap"] = self.wrap[rows]
            found["rgb"] = found["rgb"] + found["wrap"]
        return found


class Relightable(ABC):
    """A subject that can be relit in a frame."""

    keeps_photo = False  # True where the photo's own background stays behind it

    @property
    @abstractmethod
    def size_px(self) -> tuple[int, int]:
        """Height and width of the frame."""

    @property
    @abstractmethod
    def matte(self) -> np.ndarray:
        """Share [H, W] of the frame that is relit."""

    @property
    def person_matte(self) -> np.ndarray | None:
        """The matte of a photo's person, which images hold as a layer; None of a face alone."""
        return None

    @property
    @abstractmethod
    def nbytes(self) -> int:
        """Bytes of the subject under one sum of lights."""

    @abstractmethod
    def relit(self, lights: Any) -> Iterator[Any]:
        """Relight the subject by M sums of lights at once; one prediction serves all."""

    @abstractmethod
    def renderer(self, request: RenderRequest) -> Callable[[slice], dict[str, np.ndarray]]:
        """What gives rows [h, W, ...] of all that is asked; what does not depend on rows is computed first.

        Raises UsageError for layers that this subject lacks.
        """

    @abstractmethod
    def exposure_ev(self, relit: Any, rule: ExposureRule) -> float:
        """The exposure in EV of the subject under one sum of lights, by a rule."""

    def relit_images(self, lights_of: Callable[[slice], Any], sums: Sequence[int]) -> Iterator[list[Any]]:
        """Relight the subject for images that need some `sums` of lights each; yield a list for each image.

        As many images at a time as fit the memory share one prediction. `lights_of` gives the lights of a
        range of all sums.
        """
        first = 0
        for part in self.parts(sums):
            last = first + sum(sums[part])
            found = self.relit(lights_of(slice(first, last)))
            yield from ([*islice(found, count)] for count in sums[part])
            first = last

    def parts(self, sums: Sequence[int]) -> list[slice]:
        """As many images at a time as fit the memory, of images that need some `sums` of lights each."""
        return batches(len(sums), max(sums, default=1) * self.nbytes)

    def rendered(self, request: RenderRequest, empty: Empty = new_array) -> dict[str, np.ndarray]:
        """All rows of what is asked; `empty` makes the array of a layer, by its name and shape.

        Raises UsageError for layers that this subject lacks.
        """
        return in_strips(self.renderer(request), *self.size_px, empty)

    def image(self, relit: Any) -> np.ndarray:
        """The image [H, W, 3] under one sum of lights, not multiplied by alpha."""
        return self.rendered(RenderRequest(relit))["rgb"]

    def alpha(self, background: Rows | None = None) -> np.ndarray | None:
        """The matte where nothing is behind the subject, else None."""
        return self.matte if background is None and not self.keeps_photo else None

    def light_layer(self, relit: Any) -> np.ndarray:
        """The subject [H, W, 3] under one of several lights, over black."""
        return self.rendered(RenderRequest(lights={"": relit}))[""]
