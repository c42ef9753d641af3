"""Light in the axes of other programs: DPR's and SfSNet's coefficients, Blender's and Mitsuba's maps.

Ours are the camera's: x right, y up, z toward the camera; a map's centre is +z, u = 0.25 is +x.

A light in the form in which it came, given in the form that is asked for: map, rig or coefficients.
"""

import math
from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor

from facerf_cli.light.envmap import envmap_weights, texel_integrals
from facerf_cli.light.rig_latlong import rig_to_latlong
from facerf_cli.light.sh import (
    coefficients_to_rig,
    latlong_coefficients,
    order_of,
    positive_latlong,
    rig_coefficients,
    rotated,
    sh_to_latlong,
)
from facerf_cli.light.sphere import RigLight, latlong_solid_angles, rig_directions

MapAxes = Literal["facerf", "blender", "mitsuba"]
# Azimuth that a map of ours has to gain to be another's. Both hold for a head that looks at the viewer:
# - Mitsuba (src/emitters/envmap.cpp, eval: u = atan2(x, -z) / 2 pi, v = acos(y) / pi): the head looks along
#   its +z, y up, and the map is ours as it stands.
# - Blender (Cycles' kernel/camera/projection.h, direction_to_equirectangular: u = 0.5 - atan2(y, x) / 2 pi):
#   the head looks along -Y, Z up, as in its front view; ours, a quarter of the width to the right. Seen in
#   Blender 4.5.15 (bpy, Cycles): a white ball under two converted maps is our irradiance to 1 %.
_GAIN_DEG: dict[MapAxes, float] = {"facerf": 0, "mitsuba": 0, "blender": -90}

_CAMERA_TO_DPR = torch.tensor([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]], dtype=torch.float64)
_SFSNET_ORDER = [0, 2, 3, 1, 6, 7, 5, 8, 4]  # our index of each of its nine
_LUMINANCE = torch.tensor([0.2126, 0.7152, 0.0722])  # of linear Rec.709


def to_map_axes(envmap: Tensor, axes: MapAxes) -> Tensor:
    """Our map [H, W, 3] as the other program wants it."""
    return _turned(envmap, _GAIN_DEG[axes])


def from_map_axes(envmap: Tensor, axes: MapAxes) -> Tensor:
    """The other program's map [H, W, 3] as ours."""
    return _turned(envmap, -_GAIN_DEG[axes])


def _turned(envmap: Tensor, gain_deg: float) -> Tensor:
    """The map with `gain_deg` added to every azimuth: exactly, where that is whole pixels."""
    height, width = envmap.shape[:2]
    pixels = -gain_deg / 360 * width  # azimuth grows to the left
    if pixels == round(pixels):
        return envmap.roll(round(pixels), dims=1)
    areas = latlong_solid_angles(height, width, torch.float64)[..., None]
    return (texel_integrals(envmap, height, width, gain_deg) / areas).to(envmap.dtype)


def to_dpr(coefficients: Tensor) -> Tensor:
    """Nine grey numbers of DPR from coefficients [K, 3], K >= 9: of the light's luminance.

    Zhou et al., *Deep Single-Image Portrait Relighting*, 2019. Its shading is its basis at the normal times
    the nine (utils/utils_SH.py: the orthonormal harmonics in our order, times the cosine lobe's pi, 2 pi / 3,
    pi / 4), with x right, y into the picture and z up (the half-sphere of its testNetwork_demo_512.py). We
    take its shading for a white surface's radiance, irradiance over pi; its own examples have a first number
    of about 0.8, so a light far from that is to be scaled.
    """
    grey = coefficients[:9] @ _LUMINANCE.to(coefficients)
    return rotated(grey[:, None], _CAMERA_TO_DPR)[:, 0] / math.pi


def from_dpr(numbers: Tensor) -> Tensor:
    """Coefficients [9, 3] of DPR's nine numbers, grey."""
    return rotated(math.pi * numbers[:, None], _CAMERA_TO_DPR.T).expand(9, 3).contiguous()


def to_sfsnet(coefficients: Tensor) -> Tensor:
    """SfSNet's 27 numbers, nine a channel, from coefficients [K, 3], K >= 9.

    Sengupta et al., *SfSNet*, 2018 (functions/normal_harmonics.m, create_shading_recon.m): orthonormal
    harmonics times the cosine lobe at the normal, in the order 1, z, x, y, 3z^2-1, xz, yz, x^2-y^2, xy. Its
    source does not name its axes; they are taken for x right, y up, z toward the camera. The unit is DPR's.
    """
    return (coefficients[_SFSNET_ORDER] / math.pi).T.reshape(27)


def from_sfsnet(numbers: Tensor) -> Tensor:
    """Coefficients [9, 3] of SfSNet's 27 numbers."""
    coefficients = numbers.new_zeros(9, 3)
    coefficients[_SFSNET_ORDER] = math.pi * numbers.reshape(3, 9).T
    return coefficients


DEFAULT_ROWS = 256  # of a map whose size nobody says
DEFAULT_ORDER = 2  # what the shading of a matte surface shows
_ROWS_BETWEEN = 512  # of the map that leads to a rig


@dataclass(frozen=True, eq=False)
class LightForms:
    """One light: exactly one of a map [H, 2 H, 3], a rig's light, and coefficients [K, 3] is given.

    A map or a rig of coefficients is a light that can shine, nowhere negative (`light/sh.py`);
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
