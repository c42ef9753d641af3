"""Head around the canonical face: skull, sides and neck, which continue any face smoothly.

A table of section depths around the vertical axis of the head describes an average head. The depths were
measured on the ICT-FaceKit mean without ears and shoulders and rounded to half a millimetre; the table holds
none of its vertices. Kriging carries the difference between the border of a face and the average head
outward, so that position and slope are continuous across the border and the difference fades over the skull.

A point of the head is given by (u, level). u continues the face's UV map around the head. level
is v from the upper edge of the UV map (v = 0) down; above that edge it is minus the arc length over the
crown, in units of the height of the UV map.
"""

from functools import cache

import numpy as np
import torch
from scipy.interpolate import RectBivariateSpline
from scipy.ndimage import map_coordinates
from scipy.spatial.distance import cdist

from facerf_cli.face.topology import BOTTOM_M, GRID, HALF_ANGLE_DEG, TOP_M, grid_uv
from facerf_cli.run.workers import one_thread
from facerf_cli.synth import tables_of

BACK_U = 0.5 + 180 / (2 * HALF_ANGLE_DEG)  # the seam at the back of the head; its other side is 1 - BACK_U
_CROWN_MM_PER_DEG = 1.4  # arc length over the crown
CROWN_LEVEL = -90 * _CROWN_MM_PER_DEG / 1000 / (TOP_M - BOTTOM_M)  # of the pole
NECK_LEVEL = 1.506  # of the lower end of the neck

_ROUNDING_MM = 0.3  # standard deviation of the table's rounding, which the spline smooths away
_REACHES_MM = ((55.0, 1.0), (14.0, 0.03))  # (reach, variance) of broad and of small differences at the border
_RING_STEP, _RING_INSIDE = 4, 5  # every fourth vertex of the border, and of a ring five cells inside it
_SCALE_LIMITS = (0.85, 1.2)  # of the size of a head, relative to the average head
_PAD = 6  # the grid is extended by this many cells, to keep the spline good up to the border


def average_head_mm(u: np.ndarray, level: np.ndarray) -> np.ndarray:
    """Return the average head [..., 3] in millimetres at (u, level) [...]."""
    azimuth_deg = (u - 0.5) * 2 * HALF_ANGLE_DEG
    length = -level * (TOP_M - BOTTOM_M) * 1000
    across, y = ((s.ev(length, azimuth_deg) + s.ev(length, -azimuth_deg)) / 2 for s in _profiles())
    azimuth = np.radians(azimuth_deg)
    return np.stack([across * np.sin(azimuth), y, across * np.cos(azimuth)], -1)


@cache  # all heads share it
def _profiles() -> tuple[RectBivariateSpline, RectBivariateSpline]:
    """Fit distance from the axis and height, in mm, by splines over (arc length above `TOP_M`, azimuth)."""
    tables = {name: np.array(rows, float) for name, rows in tables_of(__file__).items()}
    crown, sections, half = tables["crown_mm"], tables["sections_mm"], tables["azimuths_deg"]
    top = TOP_M * 1000
    elevation = np.radians(crown[:, :1])
    across = np.concatenate([crown[:, 1:] * np.cos(elevation), sections[:, 1:]])[::-1]
    heights = np.broadcast_to(sections[:, :1], sections[:, 1:].shape)
    y = np.concatenate([top + crown[:, 1:] * np.sin(elevation), heights])[::-1]
    length = np.concatenate([crown[:, 0] * _CROWN_MM_PER_DEG, sections[:, 0] - top])[::-1]
    azimuths = np.concatenate([half[-4:-1] - 360, -half[:0:-1], half, 360 - half[-2:-5:-1]])
    folded = np.where(np.abs(azimuths) > 180, 360 - np.abs(azimuths), np.abs(azimuths))
    column = np.searchsorted(half, folded)
    smoothing = across[:, column].size * _ROUNDING_MM**2
    return (
        RectBivariateSpline(length, azimuths, across[:, column], s=smoothing),
        RectBivariateSpline(length, azimuths, y[:, column], s=smoothing),
    )


def face_surface(vertices_mm: np.ndarray, uv: np.ndarray) -> np.ndarray:
    """Interpolate the surface [N, 3] of a canonical face at (u, v) [N, 2] in 0..1 by a cubic spline."""
    grid = vertices_mm.reshape(GRID, GRID, 3)
    padded = np.pad(grid, ((_PAD, _PAD), (_PAD, _PAD), (0, 0)), "reflect", reflect_type="odd")
    at = np.stack([uv[:, 1], uv[:, 0]]) * (GRID - 1) + _PAD
    return np.stack([map_coordinates(padded[..., axis], at, order=3) for axis in range(3)], -1)


class Surroundings:
    """Head outside the face at fixed (u, level) [N, 2], for many faces."""

    def __init__(self, u_level: np.ndarray) -> None:
        uv = grid_uv().double().numpy()
        self._rings = _rings()
        known = average_head_mm(*uv[self._rings].T)
        self._known, self._wanted = known, average_head_mm(*u_level.T)
        covariance = _kernel(known, known) + 1e-7 * np.eye(len(known))
        with one_thread():  # rounding in numpy's solver depends on the number of cores
            inverse = torch.linalg.inv(torch.from_numpy(covariance))
            chunks = np.array_split(self._wanted, 16)
            self._carry = torch.cat([(torch.from_numpy(_kernel(c, known)) @ inverse).float() for c in chunks])

    def positions(self, vertices_mm: np.ndarray) -> np.ndarray:
        """Return the surface [N, 3] in millimetres that continues the face `vertices_mm` [V, 3]."""
        border = vertices_mm[self._rings]
        scale, shift = _similarity(self._known, border)
        difference = border - (self._known * scale + shift)
        with one_thread():
            carried = self._carry @ torch.from_numpy(difference).float()
        return self._wanted * scale + shift + carried.numpy()


def _rings() -> np.ndarray:
    """Return ids [R] of face vertices along the border and along a ring inside it."""
    rows = []
    for inside in (0, _RING_INSIDE):
        near, far = inside, GRID - 1 - inside
        along = np.unique([*range(near, GRID // 2, _RING_STEP), GRID // 2])
        along = np.unique([*along, *(GRID - 1 - along)])
        row, col = (axis.ravel() for axis in np.meshgrid(along, along, indexing="ij"))
        edge = (row == near) | (row == far) | (col == near) | (col == far)
        rows.append((row * GRID + col)[edge])
    return np.concatenate(rows)


def _kernel(a_mm: np.ndarray, b_mm: np.ndarray) -> np.ndarray:
    """Matern 5/2 covariance: twice differentiable, so that slopes are continuous across the border."""
    distance = cdist(a_mm, b_mm) * np.sqrt(5)
    return sum(
        share * (1 + distance / reach + (distance / reach) ** 2 / 3) * np.exp(-distance / reach)
        for reach, share in _REACHES_MM
    )


def _similarity(known: np.ndarray, border: np.ndarray) -> tuple[float, np.ndarray]:
    """Scale and shift [3] that bring the average head nearest to this one, without the jaw, which moves."""
    steady = known[:, 1] > -20
    a, b = known[steady], border[steady]
    centred = a - a.mean(0)
    scale = float(np.clip((centred * (b - b.mean(0))).sum() / (centred**2).sum(), *_SCALE_LIMITS))
    return scale, b.mean(0) - scale * a.mean(0)
