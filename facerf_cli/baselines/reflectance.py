"""What the field and the baselines have in common: relighting a face, and explaining its photo.

Every model here is linear in its light, and a light is always given as a rig's weights (`RigLight`), so that
what one model reads off a photo can be handed to another.
"""

from dataclasses import dataclass
from typing import Protocol

from torch import Tensor

from facerf_cli.baselines.kinds import Kind as Kind
from facerf_cli.light.rig_light import RigLight


class Reflectance(Protocol):
    """The reflectance of one face, read off one photo."""

    def relit(self, directions: Tensor, weights: Tensor, turn: Tensor | None = None) -> Tensor:
        """Textures [M, 3, T, T], linear, under M sums, weights [M, L, 3], of camera-space lights [L, 3].

        `turn` [3, 3] rotates the head from its pose in the photo (`pipeline.turn_to`); lights stay with the
        camera.
        """


@dataclass(frozen=True, eq=False)
class Explained:
    """A photo taken apart: relit by its own light, the reflectance gives the photo's texture back."""

    reflectance: Reflectance
    light: RigLight
