"""The outer surface of a head as one height field, which keeps hair and clothes out of the skin.

The field is that of a capsule: above the middle of the skull a point is measured along the ray from that
middle, below it along the horizontal from the vertical line through it. Crown, neck and shoulders thus all
have one radius for each azimuth and arc. Arc is 0 at the height of the middle, positive above, negative
below.
"""

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import distance_transform_edt, gaussian_filter, map_coordinates

from facerf_cli.synth.head.mesh import PARTS, HeadMesh, unit

_AZIMUTHS = 96
_ARC_M = 0.004  # height of a cell
RADIUS_M = 0.09  # arc per radian of elevation
_LOWEST_M = -0.36  # arc of the lowest row
_MIDDLE_M = 0.045  # height of the capsule's middle: the widest part of the skull, above the ears
_SLICE_M = (0.07, 0.09)  # range of heights in which front and back of the skull are measured
_STEP_M = 0.002  # step over which the slope of the field is measured
_SMOOTH_CELLS = 0.8  # sigma of the Gaussian that smooths the field
_OUTER = [PARTS.index("skin"), PARTS.index("cloth")]  # parts that the field covers


@dataclass(frozen=True, eq=False)
class Hull:
    """Radius [rows, azimuths] in metres of the outermost surface around `middle` [3]; smooth and closed."""

    middle: np.ndarray
    radius: np.ndarray

    def height(self, points: np.ndarray) -> np.ndarray:
        """Distance [...] of points [..., 3] outside the hull, along the capsule's ray; negative inside."""
        out, azimuth, arc = self._coordinates(points)
        column = azimuth / (2 * np.pi) * _AZIMUTHS
        row = np.clip((arc - _LOWEST_M) / _ARC_M, 0, len(self.radius) - 1)
        padded = np.concatenate([self.radius, self.radius[:, :1]], 1)
        return out - map_coordinates(padded, [row, column % _AZIMUTHS], order=1, mode="nearest")

    def rays(self, points: np.ndarray) -> np.ndarray:
        """The unit direction [..., 3] in which the height of points [..., 3] is measured."""
        offset = points - self.middle
        offset = np.stack([offset[..., 0], np.maximum(offset[..., 1], 0), offset[..., 2]], -1)
        return unit(offset)

    def normals(self, points: np.ndarray) -> np.ndarray:
        """Unit normals [..., 3] of the level surfaces of height through points [..., 3]."""
        here = self.height(points)
        slope = np.stack([self.height(points + step) - here for step in np.eye(3) * _STEP_M], -1)
        return unit(slope)

    def lifted(self, points: np.ndarray, least: np.ndarray | float) -> np.ndarray:
        """Points [..., 3] after those lower than `least` [...] are pushed out to that height."""
        short = np.maximum(least - self.height(points), 0)
        return points + short[..., None] * self.rays(points)

    def _coordinates(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Radius, azimuth in 0..2 pi and arc [...] of points [..., 3]."""
        x, y, z = np.moveaxis(points - self.middle, -1, 0)
        level = np.hypot(x, z)
        above = np.maximum(y, 0)
        arc = np.where(y > 0, RADIUS_M * np.arctan2(above, level), y)
        return np.hypot(level, above), np.arctan2(x, z) % (2 * np.pi), arc


def hull_of(head: HeadMesh) -> Hull:
    """Build the hull of a head's skin and clothes, if it wears any."""
    corners = head.vertices[head.triangles[np.isin(head.part[head.triangles[:, 0]], _OUTER)]].astype(float)
    coarse = corners[np.linalg.norm(corners[:, 0] - corners[:, 1], axis=-1) > _ARC_M]
    sampled = [corners.mean(1), corners[:, 0], *(coarse[:, k] for k in (1, 2))]
    points = np.concatenate([*sampled, *((coarse[:, k] + coarse[:, k - 1]) / 2 for k in range(3))])
    hull = Hull(_middle(points), np.zeros((1, _AZIMUTHS)))
    out, azimuth, arc = hull._coordinates(points)
    rows = int((np.pi / 2 * RADIUS_M - _LOWEST_M) / _ARC_M) + 2
    row = np.clip(np.rint((arc - _LOWEST_M) / _ARC_M).astype(int), 0, rows - 1)
    column = np.rint(azimuth / (2 * np.pi) * _AZIMUTHS).astype(int) % _AZIMUTHS
    radius = np.zeros((rows, _AZIMUTHS))
    np.maximum.at(radius, (row, column), out)
    return Hull(hull.middle, gaussian_filter(_filled(radius), _SMOOTH_CELLS, mode=("nearest", "wrap")))


def _middle(points: np.ndarray) -> np.ndarray:
    """The capsule's middle [3], halfway between the forehead and the back of the skull."""
    belt = points[(points[:, 1] > _SLICE_M[0]) & (points[:, 1] < _SLICE_M[1])]
    return np.array([0, _MIDDLE_M, (belt[:, 2].min() + belt[:, 2].max()) / 2])


def _filled(radius: np.ndarray) -> np.ndarray:
    """Give cells that hold no point the radius of the nearest cell that does, also across the wrap-around."""
    third = radius.shape[1]
    tiled = np.tile(radius, (1, 3))
    nearest = distance_transform_edt(tiled == 0, return_distances=False, return_indices=True)
    return tiled[tuple(nearest)][:, third : 2 * third]
