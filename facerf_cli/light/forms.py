"""A light in the form in which it came, given in the form that is asked for: map, rig or coefficients."""

from dataclasses import dataclass

import torch
from torch import Tensor

from facerf_cli.light.envmap import envmap_weights, texel_integrals
from facerf_cli.light.rig_latlong import rig_to_latlong
from facerf_cli.light.rig_light import RigLight
from facerf_cli.light.sh import coefficients_to_rig, order_of, rig_coefficients
from facerf_cli.light.sh_latlong import latlong_coefficients, sh_to_latlong
from facerf_cli.light.sh_positive import positive_latlong
from facerf_cli.light.sphere import latlong_solid_angles, rig_directions

DEFAULT_ROWS = 256  # of a map whose size nobody says
DEFAULT_ORDER = 2  # what the shading of a matte surface shows
_ROWS_BETWEEN = 512  # of the map that leads to a rig


@dataclass(frozen=True, eq=False)
class LightForms:
    """One light: exactly one of a map [H, 2 H, 3], a rig's light, and coefficients [K, 3] is given.

    A map or a rig of coefficients is a light that can shine, nowhere negative (`light/sh_positive.py`);
    where `signed`, the plain series.
    """

    envmap: Tensor | None = None
    rig: RigLight | None = None
    coefficients: Tensor | None = None
    signed: bool = False

    def __str__(self) -> str:
        if self.envmap is not None:
            return f"a map of {self.envmap.shape[1]} x {self.envmap.shape[0]} pixels"
        if self.rig is not None:
            return f"{len(self.rig.weights)} lights of a rig"
        assert self.coefficients is not None
        return f"spherical harmonics of order {order_of(self.coefficients)}"

    def latlong(self, height: int | None = None) -> Tensor:
        """The map [height, 2 height, 3]; a map's own size, or 256, where no height is given.

        A map made smaller is averaged over each texel; one made larger keeps its pixels' edges.
        """
        if self.envmap is None:
            return self._drawn(height or DEFAULT_ROWS)
        if height is None or height == len(self.envmap):
            return self.envmap
        areas = latlong_solid_angles(height, 2 * height, torch.float64)[..., None]
        return (texel_integrals(self.envmap, height, 2 * height) / areas).float()

    def _drawn(self, height: int) -> Tensor:
        if self.rig is not None:
            return rig_to_latlong(self.rig, height)
        assert self.coefficients is not None
        drawn = sh_to_latlong if self.signed else positive_latlong
        return drawn(self.coefficients, height)

    def on_rig(self, directions: Tensor | None = None) -> RigLight:
        """The light of a rig of these directions [L, 3]; of its own rig, or of 150, where none are given.

        From one rig to another, or from coefficients that are not signed, it goes by a smooth map.
        """
        if self.rig is not None and (directions is None or torch.equal(directions, self.rig.directions)):
            return self.rig
        directions = rig_directions() if directions is None else directions
        if self.coefficients is not None and self.signed:
            return coefficients_to_rig(self.coefficients, directions)
        envmap = self.latlong(None if self.envmap is not None else _ROWS_BETWEEN)
        return RigLight(directions, envmap_weights(envmap, directions))

    def harmonics(self, order: int | None = None) -> Tensor:
        """Coefficients [(order + 1)^2, 3]; of their own order, or of order 2, where none is given.

        What coefficients do not say of higher orders is 0.
        """
        if self.coefficients is not None:
            found = self.coefficients
            count = len(found) if order is None else (order + 1) ** 2
            return torch.cat([found, found.new_zeros(max(0, count - len(found)), 3)])[:count]
        order = DEFAULT_ORDER if order is None else order
        if self.rig is not None:
            return rig_coefficients(self.rig, order)
        assert self.envmap is not None
        return latlong_coefficients(self.envmap, order)
