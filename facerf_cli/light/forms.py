"""Conversion of a light: between map, rig and coefficients, and to and from the axes of other programs.

Axes here are the camera's: x right, y up, z toward the camera; the centre of a map is +z, u = 0.25 is +x.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

import numpy as np
import torch
from torch import Tensor

from facerf_cli.light.envmap import cell_rows, envmap_weights, nearest_light, resampled
from facerf_cli.light.sh import (
    coefficients_to_rig,
    latlong_coefficients,
    order_of,
    positive_latlong,
    rig_coefficients,
    sh_to_latlong,
)
from facerf_cli.light.sphere import (
    RigLight,
    latlong_directions,
    rig_directions,
)

if TYPE_CHECKING:
    from scipy.spatial import cKDTree

_NEIGHBOURS = 8  # lights around a texel
_WIDTH = 0.35  # standard deviation of a light's Gaussian, in spacings of the lights
_SMOOTH_GAINS = 3  # the first is the splat itself
MapAxes = Literal["facerf", "blender", "mitsuba"]
DEFAULT_ROWS = 256  # of a map whose size is not given
DEFAULT_ORDER = 2  # which a matte surface shows
_ROWS_BETWEEN = 512  # of the map by which one rig is converted to another
# Azimuth to add to a map for another program. Both hold for a head that looks at the viewer:
# - Mitsuba (src/emitters/envmap.cpp, eval: u = atan2(x, -z) / 2 pi, v = acos(y) / pi): the head looks along
#   its +z, y up, and our map needs no change.
# - Blender (Cycles' kernel/camera/projection.h, direction_to_equirectangular: u = 0.5 - atan2(y, x) / 2 pi):
#   the head looks along -Y, Z up, as in its front view; our map moves right by a quarter of its width. In
#   Blender 4.5.15 (bpy, Cycles) a white ball under two converted maps has our irradiance to 1 %.
_ADDED_AZIMUTH_DEG: dict[MapAxes, float] = {"facerf": 0, "mitsuba": 0, "blender": -90}


def rig_to_latlong(light: RigLight, height: int) -> Tensor:
    """Radiance [height, 2 height, 3] float32 of a smooth map that has the weights [L, 3] of a rig's light.

    Three times the gain that each light's weight lacks in the map is splatted by a Gaussian, normalised over
    the lights around a texel; then each cell is scaled to its weight. So a single light is a soft disc in its
    cell, and non-negative weights give a non-negative map. `envmap_weights` gives them back within 1 % of the
    largest if a cell is several texels wide: for the rig of 150 lights from a height of 128 up. Lights of the
    same direction are one light. Negative weights (of a spherical-harmonic model) are converted separately
    and subtracted.
    """
    if bool((light.weights < 0).any()):
        above, below = (RigLight(light.directions, (s * light.weights).clamp(min=0)) for s in (1, -1))
        return rig_to_latlong(above, height) - rig_to_latlong(below, height)
    coarse = cell_rows(len(light.directions)) // 2
    rows = max(height, coarse)
    directions = light.directions.double().cpu()
    with_cell = np.unique(nearest_light(directions, coarse, 2 * coarse).numpy())
    lights = directions[with_cell]
    from scipy.spatial import cKDTree  # a photo does without it

    tree = cKDTree(lights.numpy())
    _, nearest = tree.query(directions.numpy())
    weights = torch.zeros(len(lights), 3).index_add_(0, torch.from_numpy(nearest), light.weights.cpu())

    def lacking(envmap: Tensor) -> Tensor:
        return weights / envmap_weights(envmap, lights).clamp(min=1e-30)

    gains: list[Tensor] = []
    for _ in range(_SMOOTH_GAINS):
        gains.append(lacking(_splat(gains, tree, coarse)))
    envmap = _splat(gains, tree, rows)
    envmap *= lacking(envmap)[nearest_light(lights, rows, 2 * rows)]
    return envmap if rows == height else resampled(envmap, height)


def _splat(gains: Sequence[Tensor], lights: "cKDTree", rows: int) -> Tensor:
    """Product [rows, 2 rows, 3] of gains [L, 3] of lights, each a mean of those around a texel."""
    envmap = torch.ones(rows, 2 * rows, 3)
    for row, texels in zip(envmap, latlong_directions(rows, 2 * rows, torch.float64).numpy(), strict=True):
        distance, near = lights.query(texels, k=range(1, min(_NEIGHBOURS, lights.n) + 1))
        nearer = (distance[:, :1] ** 2 - distance**2) * lights.n / (4 * math.pi * _WIDTH**2)
        share = torch.from_numpy(np.exp(0.5 * nearer)).float()
        for gain in gains:
            row *= torch.einsum("nk,nkc->nc", share / share.sum(1, keepdim=True), gain[near])
    return envmap


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
        if self.envmap is not None:
            return self.envmap if height in (None, len(self.envmap)) else resampled(self.envmap, height)
        height = height or DEFAULT_ROWS
        if self.rig is not None:
            return rig_to_latlong(self.rig, height)
        assert self.coefficients is not None
        return (sh_to_latlong if self.signed else positive_latlong)(self.coefficients, height)

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
    pixels = -azimuth_deg / 360 * envmap.shape[1]  # azimuth grows to the left
    if pixels == round(pixels):
        return envmap.roll(round(pixels), dims=1)
    return resampled(envmap, len(envmap), azimuth_deg)
