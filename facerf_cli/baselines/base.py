"""The interface of the field and the baselines: the reflectance of a face and the light of its photo.

Every model is linear in light, except where a baseline clamps negative light. A light is always given as
weights of a rig's lights (`RigLight`), so that the light which one model estimates from a photo can
illuminate another model.
"""

from dataclasses import dataclass
from typing import Protocol

from torch import Tensor

from facerf_cli.light.sphere import RigLight


class Reflectance(Protocol):
    """The reflectance of one face, estimated from one photo."""

    def relit(self, directions: Tensor, weights: Tensor, turn: Tensor | None = None) -> Tensor:
        """Relight the texture: linear textures [M, 3, T, T] under M weighted sums of lights.

        directions [L, 3] of the lights are in camera space, weights are [M, L, 3]. `turn` [3, 3] rotates the
        head from its pose in the photo; the lights stay fixed to the camera.
        """


@dataclass(frozen=True, eq=False)
class Explained:
    """Reflectance and light of a photo: together they approximate the photo's texture."""

    reflectance: Reflectance
    light: RigLight
