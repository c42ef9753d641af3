"""Where a light comes from, as one direction.

A rig's light as a smooth lat-long map, from which `envmap_weights` takes the same weights again.

Each light's power is spread over its cell, then smoothed over the sphere and put right, many times in turn:
mass-preserving interpolation of what is known by area (Tobler, *Smooth Pycnophylactic Interpolation for
Geographical Regions*, 1979), put right by factors that are themselves smooth (Richardson-Lucy: a point's is
the mean over the cells that it brings light to). So a lone lamp is a soft disc in its cell and a constant
light a constant map, there is neither a Voronoi edge nor a spike, and what is not negative stays so.
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

_BLUR_DEG = 12.0  # less than the paper's 150 lights are apart: 18 degrees
_ROWS = 90
_LUMINANCE = (0.2126, 0.7152, 0.0722)  # Rec.709


def brightest_direction(light: RigLight, front_only: bool = False) -> Tensor:
    """The unit direction [3] in which the light's luminance, blurred a little, is greatest; 0 if it is dark.

    Blurred by a von Mises-Fisher lobe, for a lamp between the lights of a rig is shared out among them.
    `front_only` leaves out what is behind the head's own plane (z < 0), of which shading says little.
    """
    luminance = light.weights.double() @ torch.tensor(_LUMINANCE, dtype=torch.float64)
    if front_only:
        luminance = luminance * (light.directions[:, 2] > 0)
    where = latlong_directions(_ROWS, 2 * _ROWS, torch.float64).reshape(-1, 3)
    sharpness = 1 / math.radians(_BLUR_DEG) ** 2
    blurred = torch.exp(sharpness * (where @ light.directions.double().T - 1)) @ luminance
    best = int(blurred.argmax())
    return (where[best] if blurred[best] > 0 else torch.zeros(3, dtype=torch.float64)).float()


_POINTS_A_CELL = 64
_FEWEST_POINTS, _MOST_POINTS = 4096, 1 << 17
_NEIGHBOURS = 8
_ROUNDS, _LAST_ROUNDS = 200, 30  # of smoothing and putting right; of putting right alone
_TEXELS_AT_ONCE = 1 << 16


def rig_to_latlong(light: RigLight, height: int) -> Tensor:
    """Radiance [height, 2 height, 3] float32 of a map that has the weights [L, 3] of a rig's light.

    `envmap_weights` gives them back to better than 1 % of the largest where a cell is some texels wide: for
    the rig of 150 lights from a height of 128 up. Lights in one place are one light. Negative weights (of a
    spherical-harmonic model) are spread by themselves and taken off.
    """
    directions, weights = _told_apart(light)
    points = _points(directions)
    parts = np.concatenate([weights.clip(min=0), (-weights).clip(min=0)], 1)  # [L, 6]
    spread = _spread(parts, directions, points)
    radiance = spread[:, :3] - spread[:, 3:]
    rows = cell_rows(len(directions))
    if height >= rows:
        return _map_of(radiance, points, height)
    areas = latlong_solid_angles(height, 2 * height, torch.float64)[..., None]
    fine = _map_of(radiance, points, rows)
    return (texel_integrals(fine, height, 2 * height) / areas).float()


def _told_apart(light: RigLight) -> tuple[np.ndarray, np.ndarray]:
    """Directions and weights [L, 3] of lights that have a cell; those of one place become one."""
    directions = light.directions.double().cpu().numpy()
    rows = cell_rows(len(directions))
    own = directions[np.unique(nearest_light(light.directions, rows, 2 * rows).numpy())]
    weights = np.zeros((len(own), 3))
    np.add.at(weights, cKDTree(own).query(directions)[1], light.weights.double().cpu().numpy())
    return own, weights


def _points(directions: np.ndarray) -> np.ndarray:
    """Unit vectors [N, 3] evenly over the sphere, and one in each cell [L, 3] that they miss."""
    count = min(max(_POINTS_A_CELL * len(directions), _FEWEST_POINTS), _MOST_POINTS)
    even = golden_spiral(count)
    missed = np.setdiff1d(np.arange(len(directions)), cKDTree(directions).query(even)[1])
    return np.concatenate([even, directions[missed]])


def _spread(weights: np.ndarray, directions: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Radiance [N, C] at points [N, 3] whose map has non-negative weights [L, C] in the cells [L, 3]."""
    smooth, weigh = _matrices(directions.tobytes())
    shares = (diags(1 / np.asarray(weigh.sum(0)).ravel()) @ weigh.T).tocsr()  # [N, L], rows sum to 1
    radiance = shares @ (weights / np.asarray(weigh.sum(1)))
    rounds = min(
        _ROUNDS, _ROUNDS * len(points) // (_POINTS_A_CELL * len(directions))
    )  # till cells are smooth
    for turn in range(rounds + _LAST_ROUNDS):
        if turn < rounds:
            radiance = smooth @ radiance
        found = weigh @ radiance
        radiance *= shares @ np.divide(weights, found, out=np.zeros_like(found), where=found > 0)
    return radiance


@lru_cache(maxsize=2)  # one photo after the other has the same rig
def _matrices(directions_bytes: bytes) -> tuple[csr_matrix, csr_matrix]:
    """What smooths radiance at the points [N, N]; from it to the weights of its map's cells [L, N]."""
    directions = np.frombuffer(directions_bytes).reshape(-1, 3)
    points = _points(directions)
    rows = cell_rows(len(directions))
    texels = latlong_directions(rows, 2 * rows, torch.float64).reshape(-1, 3).numpy()
    areas = latlong_solid_angles(rows, 2 * rows, torch.float64).reshape(-1).numpy()
    cell = cKDTree(directions).query(texels)[1]
    shape = (len(directions), len(texels))
    sums = csr_matrix((areas / math.pi, (cell, np.arange(len(texels)))), shape)
    return _blur(points, points, 1.0), sums @ _texel_blur(texels, points)


def _map_of(radiance: np.ndarray, points: np.ndarray, height: int) -> Tensor:
    """The map [height, 2 height, 3] float32 of radiance [N, 3] at the points."""
    texels = latlong_directions(height, 2 * height, torch.float64).reshape(-1, 3)
    blocks = [_texel_blur(part.numpy(), points) @ radiance for part in torch.split(texels, _TEXELS_AT_ONCE)]
    return torch.from_numpy(np.concatenate(blocks)).float().reshape(height, 2 * height, 3)


def _texel_blur(texels: np.ndarray, points: np.ndarray) -> csr_matrix:
    return _blur(texels, points, 0.7)


def _blur(at: np.ndarray, points: np.ndarray, width: float) -> csr_matrix:
    """Matrix [M, N] to places [M, 3] from the points: Gaussian over a few neighbours, rows sum to 1.

    `width` is its standard deviation in spacings of the points.
    """
    spacing = math.sqrt(4 * math.pi / len(points))
    distance, near = cKDTree(points).query(at, k=_NEIGHBOURS)
    share = np.exp(-0.5 * (distance / (width * spacing)) ** 2)
    row = np.repeat(np.arange(len(at)), _NEIGHBOURS)
    matrix = csr_matrix((share.ravel(), (row, near.ravel())), (len(at), len(points)))
    return diags(1 / np.asarray(matrix.sum(1)).ravel()) @ matrix
