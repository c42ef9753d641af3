"""A smooth lat-long map of a rig's light, from which `envmap_weights` gives the same weights again.

The power of each light is spread over its cell, then smoothed over the sphere and corrected, many times in
alternation. This is mass-preserving interpolation of values that are known by area (Tobler, *Smooth
Pycnophylactic Interpolation for Geographical Regions*, 1979), with correction factors that are smooth, too
(Richardson-Lucy: the factor of a point is a mean over the cells to which it contributes). A single light
becomes a soft disc in its cell and a constant light a constant map, without Voronoi edges or spikes, and
non-negative weights give a non-negative map.
"""

import math
from functools import lru_cache

import numpy as np
import torch
from scipy.sparse import csr_matrix, diags
from scipy.spatial import cKDTree
from torch import Tensor

from facerf_cli.light.envmap import cell_rows, nearest_light, texel_integrals
from facerf_cli.light.sphere import RigLight, golden_spiral, latlong_directions, latlong_solid_angles

_POINTS_PER_CELL = 64  # at which radiance is found
_FEWEST_POINTS, _MOST_POINTS = 4096, 1 << 17
_NEIGHBOURS = 8  # points over which a blur extends
_ROUNDS = 200  # of smoothing and correction, in which cells become smooth
_LAST_ROUNDS = 30  # of correction alone
_SMOOTHING, _TEXEL_BLUR = 1.0, 0.7  # standard deviations of blurs, in spacings of the points
_TEXELS_AT_ONCE = 1 << 16


def rig_to_latlong(light: RigLight, height: int) -> Tensor:
    """Radiance [height, 2 height, 3] float32 of a map that has the weights [L, 3] of a rig's light.

    `envmap_weights` gives them back within 1 % of the largest if a cell is several texels wide: for the rig
    of 150 lights from a height of 128 up. Lights of the same direction are one light. Negative weights (of a
    spherical-harmonic model) are spread separately and subtracted.
    """
    directions, weights = _distinct_lights(light)
    points = _points(directions)
    parts = np.concatenate([weights.clip(min=0), (-weights).clip(min=0)], 1)  # [L, 6]
    spread = _spread(parts, directions, points)
    radiance = spread[:, :3] - spread[:, 3:]
    rows = cell_rows(len(directions))
    if height >= rows:
        return _to_map(radiance, points, height)
    areas = latlong_solid_angles(height, 2 * height, torch.float64)[..., None]
    fine = _to_map(radiance, points, rows)
    return (texel_integrals(fine, height, 2 * height) / areas).float()


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
    return _blur(points, points, _SMOOTHING), sums @ _texel_blur(texels, points)


def _to_map(radiance: np.ndarray, points: np.ndarray, height: int) -> Tensor:
    """Resample radiance [N, 3] at the points to a map [height, 2 height, 3] float32."""
    texels = latlong_directions(height, 2 * height, torch.float64).reshape(-1, 3)
    blocks = [_texel_blur(part.numpy(), points) @ radiance for part in torch.split(texels, _TEXELS_AT_ONCE)]
    return torch.from_numpy(np.concatenate(blocks)).float().reshape(height, 2 * height, 3)


def _texel_blur(texels: np.ndarray, points: np.ndarray) -> csr_matrix:
    return _blur(texels, points, _TEXEL_BLUR)


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
