"""Interface of the neural field and the baselines: reflectance of a face and light of its photo.

All models are linear in light, except that baselines clamp negative light. A light is always a set of weights
of a rig's lights (`RigLight`), so that the light estimated by one model can illuminate another.
"""

from dataclasses import dataclass
from typing import Protocol

from torch import Tensor

from facerf_cli.light.sphere import RigLight


class Reflectance(Protocol):
    """Reflectance of one face, estimated from one photo."""

    def relit(self, directions: Tensor, weights: Tensor, turn: Tensor | None = None) -> Tensor:
        """Compute the linear textures [M, 3, T, T] under M weighted sums of lights.

        The lights' directions [L, 3] are in camera space; weights are [M, L, 3]. `turn` [3, 3] rotates the
        head from its pose in the photo; the lights stay fixed to the camera.
        """


@dataclass(frozen=True, eq=False)
class Explained:
    """Reflectance and light that together approximate a photo's texture."""

    reflectance: Reflectance
    light: RigLight
