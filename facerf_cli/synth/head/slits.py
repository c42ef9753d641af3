"""Lips and lids that meet: slits of a head mesh whose edges are brought together.

A linear face model leaves closed lips and lids open or lets them cross, by a different width for each person.
"""

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from facerf_cli.face.topology import LANDMARK_UV

_COLUMNS = 33  # positions across a slit at which its width is measured
_LIP_OVERLAP_M, _LID_OVERLAP_M = 0.0004, 0.0008  # of closed edges, which subdivision rounds off
_LIP_REACH_M, _LID_REACH_M = 0.006, 0.004  # standard deviation of the area around a slit that moves along
_LIP_MARGIN_UV = np.array([0, 0.04])  # margin around the inner lip landmarks in which lip edges are searched
_LID_RINGS = 5  # rings of vertices from the inner border of the lids that are searched for their edges
_INNER_LIPS_UV = LANDMARK_UV[60:68]


@dataclass(frozen=True, eq=False)
class Slit:
    """A slit between an upper and a lower edge.

    upper, lower: vertex ids of the edges from left to right; weight [N] in [-1, 1]: displacement of each
    vertex when the slit opens by 1, positive (up) on the upper side; overlap_m: overlap of closed edges.
    """

    upper: np.ndarray
    lower: np.ndarray
    weight: np.ndarray
    overlap_m: float

    def closing(self, shape: np.ndarray) -> np.ndarray:
        """Offsets along y [N] that bring the edges of a head [N, 3] together, whether they gape or cross."""
        ends = [shape[edge][[0, -1], 0] for edge in (self.upper, self.lower)]
        columns = np.linspace(max(ends[0][0], ends[1][0]), min(ends[0][1], ends[1][1]), _COLUMNS)
        upper, lower = (
            np.interp(columns, *_rising(shape[edge, 0], shape[edge, 1])) for edge in (self.upper, self.lower)
        )
        width = upper - lower + self.overlap_m
        width = np.convolve(np.pad(width, 2, mode="edge"), [0.1, 0.2, 0.4, 0.2, 0.1], "valid")
        width *= np.minimum(1, np.minimum(np.arange(_COLUMNS), np.arange(_COLUMNS)[::-1]) / 2)
        return -self.weight * np.interp(shape[:, 0], columns, width, left=0, right=0)


def _rising(x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """x [K] sorted, and y [K] in the same order."""
    order = np.argsort(x)
    return x[order], y[order]


def eye_slit(mean: np.ndarray, shut: np.ndarray, loop: np.ndarray, triangles: np.ndarray) -> Slit:
    """Find the slit between the lids around a loop [K] of the skin's border.

    mean [N, 3] has open eyes, shut [N, 3] is the mean with a blink. Of the rings of vertices around the loop,
    the lid edges are those that come nearest to each other when shut.
    """
    corners = loop[[mean[loop, 0].argmin(), mean[loop, 0].argmax()]]
    above = mean[:, 1] > np.interp(mean[:, 0], *mean[corners, :2].T)
    middle = np.abs(mean[:, 0] - mean[corners, 0].mean()) < np.ptp(mean[corners, 0]) / 4
    rings = _rings(loop, triangles)
    upper = min((ring[above[ring]] for ring in rings), key=lambda ids: shut[ids[middle[ids]], 1].mean())
    lower = max((ring[~above[ring]] for ring in rings), key=lambda ids: shut[ids[middle[ids]], 1].mean())
    edges = upper[np.argsort(mean[upper, 0])], lower[np.argsort(mean[lower, 0])]
    return Slit(*edges, _weight(mean, *edges, np.unique(triangles), above, _LID_REACH_M, 0.7), _LID_OVERLAP_M)


def _rings(loop: np.ndarray, triangles: np.ndarray) -> list[np.ndarray]:
    """A loop [K] of vertices, then its neighbours, then their neighbours and so on."""
    rings, seen = [loop], np.zeros(triangles.max() + 1, bool)
    for _ in range(_LID_RINGS):
        seen[rings[-1]] = True
        around = np.unique(triangles[seen[triangles].any(-1)])
        rings.append(around[~seen[around]])
    return rings


def lip_slit(mean: np.ndarray, uv: np.ndarray, skin: np.ndarray, soft: np.ndarray, jaw: np.ndarray) -> Slit:
    """Find the slit between the lips; jaw [N, 3]: the shape that opens it, soft: ids of skin and mouth."""
    low, high = _INNER_LIPS_UV.min(0) - _LIP_MARGIN_UV, _INNER_LIPS_UV.max(0) + _LIP_MARGIN_UV
    lips = skin[((uv[skin] > low) & (uv[skin] < high)).all(-1)]
    fall = np.linalg.norm(jaw, axis=-1)
    above = fall < fall[lips].max() / 2
    edges = _edges(mean, lips, above, mean[lips, 0].min(), mean[lips, 0].max())
    return Slit(*edges, _weight(mean, *edges, soft, above, _LIP_REACH_M, 0.5), _LIP_OVERLAP_M)


def _edges(
    mean: np.ndarray, ids: np.ndarray, above: np.ndarray, left: float, right: float
) -> tuple[np.ndarray, np.ndarray]:
    """The lowest vertex above the slit and the highest below it, in columns from left to right."""
    column = np.digitize(mean[ids, 0], np.linspace(left, right, _COLUMNS))
    upper, lower = [], []
    for index in range(1, _COLUMNS):
        over, under = (ids[(column == index) & side] for side in (above[ids], ~above[ids]))
        upper += [over[mean[over, 1].argmin()]] if len(over) else []
        lower += [under[mean[under, 1].argmax()]] if len(under) else []
    return np.array(upper), np.array(lower)


def _weight(
    mean: np.ndarray,
    upper: np.ndarray,
    lower: np.ndarray,
    movable: np.ndarray,
    above: np.ndarray,
    reach_m: float,
    share: float,
) -> np.ndarray:
    """Weights [N] of `Slit`, which fall with the distance from the edge; `share`: part of the upper side."""
    weight = np.zeros(len(mean))
    for edge, side, part in ((upper, above, share), (lower, ~above, share - 1)):
        own = movable[side[movable]]
        away, _ = cKDTree(mean[edge]).query(mean[own])
        weight[own] = part * np.exp(-((away / reach_m) ** 2) / 2)
    return weight
