"""Conversion of a light: between map, rig and coefficients, and to and from the axes of other programs.

Axes here are the camera's: x right, y up, z toward the camera; the centre of a map is +z, u = 0.25 is +x.
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
DEFAULT_ROWS = 256  # of a map whose size is not given
DEFAULT_ORDER = 2  # which a matte surface shows
_ROWS_BETWEEN = 512  # of the map by which one rig is converted to another
_LUMINANCE = torch.tensor([0.2126, 0.7152, 0.0722])  # of linear Rec.709

# Azimuth to add to a map for another program. Both hold for a head that looks at the viewer:
# - Mitsuba (src/emitters/envmap.cpp, eval: u = atan2(x, -z) / 2 pi, v = acos(y) / pi): the head looks along
#   its +z, y up, and our map needs no change.
# - Blender (Cycles' kernel/camera/projection.h, direction_to_equirectangular: u = 0.5 - atan2(y, x) / 2 pi):
#   the head looks along -Y, Z up, as in its front view; our map moves right by a quarter of its width. In
#   Blender 4.5.15 (bpy, Cycles) a white ball under two converted maps has our irradiance to 1 %.
_ADDED_AZIMUTH_DEG: dict[MapAxes, float] = {"facerf": 0, "mitsuba": 0, "blender": -90}

_CAMERA_TO_DPR = torch.tensor([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]], dtype=torch.float64)
_SFSNET_ORDER = [0, 2, 3, 1, 6, 7, 5, 8, 4]  # our index of each of its nine coefficients


@dataclass(frozen=True, eq=False)
class LightForms:
    """One light in the form in which it was given: a map [H, 2 H, 3], a rig's light or coefficients [K, 3].

    Coefficients are converted to a non-negative map or rig (`sh.positive_latlong`), or, if `signed`, to the
    values of their series.
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
        """The light as a map [height, 2 height, 3]; by default of the given map's size, or of 256 rows.

        A map is resized by averages over texels: a larger one keeps the edges of its pixels.
        """
        if self.envmap is None:
            return self._to_latlong(height or DEFAULT_ROWS)
        if height is None or height == len(self.envmap):
            return self.envmap
        areas = latlong_solid_angles(height, 2 * height, torch.float64)[..., None]
        return (texel_integrals(self.envmap, height, 2 * height) / areas).float()

    def _to_latlong(self, height: int) -> Tensor:
        if self.rig is not None:
            return rig_to_latlong(self.rig, height)
        assert self.coefficients is not None
        to_latlong = sh_to_latlong if self.signed else positive_latlong
        return to_latlong(self.coefficients, height)

    def on_rig(self, directions: Tensor | None = None) -> RigLight:
        """The light as a rig of these directions [L, 3]; by default of the given rig, or of 150 lights.

        Another rig, and coefficients that are not signed, are converted by a smooth map.
        """
        if self.rig is not None and (directions is None or torch.equal(directions, self.rig.directions)):
            return self.rig
        directions = rig_directions() if directions is None else directions
        if self.coefficients is not None and self.signed:
            return coefficients_to_rig(self.coefficients, directions)
        envmap = self.latlong(None if self.envmap is not None else _ROWS_BETWEEN)
        return RigLight(directions, envmap_weights(envmap, directions))

    def harmonics(self, order: int | None = None) -> Tensor:
        """The light as coefficients [(order + 1)^2, 3]; by default of the given order, or of order 2.

        Given coefficients are 0 above their order.
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


def to_map_axes(envmap: Tensor, axes: MapAxes) -> Tensor:
    """Convert a map [H, W, 3] to the axes of another program."""
    return _rotated(envmap, _ADDED_AZIMUTH_DEG[axes])


def from_map_axes(envmap: Tensor, axes: MapAxes) -> Tensor:
    """Convert a map [H, W, 3] from the axes of another program."""
    return _rotated(envmap, -_ADDED_AZIMUTH_DEG[axes])


def _rotated(envmap: Tensor, azimuth_deg: float) -> Tensor:
    """Add `azimuth_deg` to every azimuth of a map: exactly, if that is a whole number of pixels."""
    height, width = envmap.shape[:2]
    pixels = -azimuth_deg / 360 * width  # azimuth grows to the left
    if pixels == round(pixels):
        return envmap.roll(round(pixels), dims=1)
    areas = latlong_solid_angles(height, width, torch.float64)[..., None]
    return (texel_integrals(envmap, height, width, azimuth_deg) / areas).to(envmap.dtype)


def to_dpr(coefficients: Tensor) -> Tensor:
    """Convert the luminance of coefficients [K, 3], K >= 9, to the nine numbers of DPR.

    Zhou et al., *Deep Single-Image Portrait Relighting*, 2019. Its shading is its basis at the normal times
    the nine (utils/utils_SH.py: the orthonormal harmonics in our order, times the cosine lobe's pi, 2 pi / 3,
    pi / 4), with x right, y into the image and z up (the half-sphere of its testNetwork_demo_512.py). Here
    its shading is the radiance of a white surface, irradiance over pi. In its own examples the first number
    is about 0.8, so a light far from that should be scaled.
    """
    grey = coefficients[:9] @ _LUMINANCE.to(coefficients)
    return rotated(grey[:, None], _CAMERA_TO_DPR)[:, 0] / math.pi


def from_dpr(numbers: Tensor) -> Tensor:
    """Convert the nine numbers of DPR to coefficients [9, 3] of a grey light."""
    return rotated(math.pi * numbers[:, None], _CAMERA_TO_DPR.T).expand(9, 3).contiguous()


def to_sfsnet(coefficients: Tensor) -> Tensor:
    """Convert coefficients [K, 3], K >= 9, to the 27 numbers of SfSNet, nine per channel.

    Sengupta et al., *SfSNet*, 2018 (functions/normal_harmonics.m, create_shading_recon.m): orthonormal
    harmonics times the cosine lobe at the normal, in the order 1, z, x, y, 3z^2-1, xz, yz, x^2-y^2, xy. Its
    source does not name its axes; here they are x right, y up, z toward the camera. The unit is DPR's.
    """
    return (coefficients[_SFSNET_ORDER] / math.pi).T.reshape(27)


def from_sfsnet(numbers: Tensor) -> Tensor:
    """Convert the 27 numbers of SfSNet to coefficients [9, 3]."""
    coefficients = numbers.new_zeros(9, 3)
    coefficients[_SFSNET_ORDER] = math.pi * numbers.reshape(3, 9).T
    return coefficients
