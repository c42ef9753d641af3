"""Conversion of a rig's light to a lat-long map."""

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from facerf_cli.light.envmap import cell_rows, envmap_weights, nearest_light, resampled
from facerf_cli.light.sphere import RigLight, latlong_directions

if TYPE_CHECKING:
    from scipy.spatial import cKDTree

_NEIGHBOURS = 8  # lights around a texel
_WIDTH = 0.35  # standard deviation of a light's Gaussian, in spacings of the lights
_SMOOTH_GAINS = 3  # the first is the splat itself


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
