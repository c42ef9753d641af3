"""A light as the single lights that add up to it: what is estimated, weighed and handed on."""

from dataclasses import dataclass

from torch import Tensor


@dataclass(frozen=True, eq=False)
class RigLight:
    """Unit camera-space directions [L, 3] toward the lights, and their rgb weights [L, 3].

    The units are those of `light/envmap.py`.

    Weights are not negative where a light is to be physical; the light of a spherical-harmonic model may need
    negative ones.
    """

    directions: Tensor
    weights: Tensor
