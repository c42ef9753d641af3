"""Conversion of a light: between map, rig and coefficients, and to and from the axes of other programs.

Axes here are the camera's: x right, y up, z toward the camera; the centre of a map is +z, u = 0.25 is +x.
"""

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import Literal

import numpy as np
import torch
from scipy.sparse import csr_matrix, diags
from scipy.spatial import cKDTree
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
    golden_spiral,
    latlong_directions,
    latlong_solid_angles,
    rig_directions,
)

_POINTS_PER_CELL = 64  # at which radiance is found
_FEWEST_POINTS, _MOST_POINTS = 4096, 1 << 17
_NEIGHBOURS = 8  # points over which a blur extends
_ROUNDS = 200  # of smoothing and correction, in which cells become smooth
_LAST_ROUNDS = 30  # of correction alone
_SMOOTHING, _TEXEL_BLUR = 1.0, 0.7  # standard deviations of blurs, in spacings of the points
_TEXELS_AT_ONCE = 1 << 16
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

    The power of each light is spread over its cell, then smoothed over the sphere and corrected, many times
    in alternation. This is mass-preserving interpolation of values that are known by area (Tobler, *Smooth
    Pycnophylactic Interpolation for Geographical Regions*, 1979), with correction factors that are smooth,
    too (Richardson-Lucy: the factor of a point is a mean over the cells to which it contributes). A single
    light becomes a soft disc in its cell, and non-negative weights give a non-negative map.

    `envmap_weights` gives them back within 1 % of the largest if a cell is several texels wide: for the rig
    of 150 lights from a height of 128 up. Lights of the same direction are one light. Negative weights (of a
    spherical-harmonic model) are spread separately and subtracted.
    """
    directions, weights = _distinct_lights(light)
    points = _points(directions)
    parts = np.concatenate([weights.clip(min=0), (-weights).clip(min=0)], 1)  # [L, 6]
    spread = _spread(parts, directions, points)
    radiance = spread[:, :3] - spread[:, 3:]
    envmap = _to_map(radiance, points, max(height, cell_rows(len(directions))))
    return envmap if len(envmap) == height else resampled(envmap, height)


def _distinct_lights(light: RigLight) -> tuple[np.ndarray, np.ndarray]:
    """Directions and weights [L, 3] of the lights that have a cell; others are added to the nearest."""
    directions = light.directions.double().cpu().numpy()
    rows = cell_rows(len(directions))
    own = directions[np.unique(nearest_light(light.directions, rows, 2 * rows).numpy())]
    weights = np.zeros((len(own), 3))
    np.add.at(weights, cKDTree(own).query(directions)[1], light.weights.double().cpu().numpy())
    return own, weights


def _points(directions: np.ndarray) -> np.ndarray:
    """Unit vectors [N, 3]: uniform on the sphere, and one in each cell [L, 3] that they miss."""
    count = min(max(_POINTS_PER_CELL * len(directions), _FEWEST_POINTS), _MOST_POINTS)
    even = golden_spiral(count)
    missed = np.setdiff1d(np.arange(len(directions)), cKDTree(directions).query(even)[1])
    return np.concatenate([even, directions[missed]])


def _spread(weights: np.ndarray, directions: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Radiance [N, C] at points [N, 3] of a map with non-negative weights [L, C] of cells [L, 3]."""
    smooth, to_weights = _matrices(directions.tobytes())
    # [N, L], rows sum to 1
    shares = (diags(1 / np.asarray(to_weights.sum(0)).ravel()) @ to_weights.T).tocsr()
    radiance = shares @ (weights / np.asarray(to_weights.sum(1)))
    rounds = min(_ROUNDS, _ROUNDS * len(points) // (_POINTS_PER_CELL * len(directions)))
    for index in range(rounds + _LAST_ROUNDS):
        if index < rounds:
            radiance = smooth @ radiance
        found = to_weights @ radiance
        radiance *= shares @ np.divide(weights, found, out=np.zeros_like(found), where=found > 0)
    return radiance


@lru_cache(maxsize=2)  # photos in sequence have the same rig
def _matrices(directions_bytes: bytes) -> tuple[csr_matrix, csr_matrix]:
    """Matrices that smooth radiance at the points [N, N], and give the weights of its map's cells [L, N]."""
    directions = np.frombuffer(directions_bytes).reshape(-1, 3)
    points = _points(directions)
    rows = cell_rows(len(directions))
    texels = latlong_directions(rows, 2 * rows, torch.float64).reshape(-1, 3).numpy()
    areas = latlong_solid_angles(rows, 2 * rows, torch.float64).reshape(-1).numpy()
    cell = cKDTree(directions).query(texels)[1]
    shape = (len(directions), len(texels))
    sums = csr_matrix((areas / math.pi, (cell, np.arange(len(texels)))), shape)
    return _blur(points, points, _SMOOTHING), sums @ _blur(texels, points, _TEXEL_BLUR)


def _to_map(radiance: np.ndarray, points: np.ndarray, height: int) -> Tensor:
    """Resample radiance [N, 3] at the points to a map [height, 2 height, 3] float32."""
    texels = latlong_directions(height, 2 * height, torch.float64).reshape(-1, 3)
    parts = torch.split(texels, _TEXELS_AT_ONCE)
    blocks = [_blur(part.numpy(), points, _TEXEL_BLUR) @ radiance for part in parts]
    return torch.from_numpy(np.concatenate(blocks)).float().reshape(height, 2 * height, 3)


def _blur(at: np.ndarray, points: np.ndarray, width: float) -> csr_matrix:
    """Matrix [M, N] from points to directions [M, 3]: a Gaussian over the neighbours, rows sum to 1.

    `width` is its standard deviation in spacings of the points.
    """
    spacing = math.sqrt(4 * math.pi / len(points))
    distance, near = cKDTree(points).query(at, k=_NEIGHBOURS)
    share = np.exp(-0.5 * (distance / (width * spacing)) ** 2)
    row = np.repeat(np.arange(len(at)), _NEIGHBOURS)
    matrix = csr_matrix((share.ravel(), (row, near.ravel())), (len(at), len(points)))
    return diags(1 / np.asarray(matrix.sum(1)).ravel()) @ matrix


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
