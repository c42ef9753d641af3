"""The mean face of the built-in model, from named anatomical measures (millimetres, head frame).

The neutral face is a height field over the cylinder of `topology.py`: the distance from the vertical axis at
an azimuth and a height. A table of section depths gives head, cheeks and jaw; a few measures each add nose,
eyes and mouth; last, the surface is pulled onto the 68 landmarks of `LANDMARKS_M`. Only the image's left half
is built and then mirrored. The depths were measured on the ICT-FaceKit mean face and rounded to half a
millimetre; none of its vertices are used.
"""

import numpy as np
from scipy.interpolate import CubicSpline, PchipInterpolator, RectBivariateSpline

from facerf_cli.face.topology import (
    BOTTOM_M,
    GRID,
    HALF_ANGLE_DEG,
    LANDMARK_UV,
    LANDMARKS_M,
    TOP_M,
    UV_SIZE_MM,
    grid_uv,
    inside_mm,
    landmark_weights,
)

# Section depths: height | distance from the axis at each azimuth, without nose and lips.
_AZIMUTHS_DEG = (0, 8, 16, 24, 32, 40, 48, 54.5, 61)
_SECTIONS_MM = """
 93 | 107.5 107   105.5 101.5  96    91    86.5  83   80.5
 84 | 111   110.5 109   105   100    94.5  89.5  86   83
 74 | 114   114   112   108   103    97    91.5  88   85
 66 | 116.5 117   115   110.5 104.5  98    92.5  88.5 85.5
 59 | 117.5 118   116.5 113.5 106    98.5  92.5  88.5 85.5
 52 | 117   116.5 115.5 114.5 108    99    93    88.5 85.5
 45 | 112.5 110.5 111.5 113   108    99.5  93    89   85.5
 38 | 108.5 106   110.5 110.5 106.5  99.5  93.5  89   85
 31 | 107   105.5 108.5 108.5 104.5 100    94    89.5 85
 23 | 109   109   108.5 108.5 106   101.5  95    89.5 84
 14 | 111   110.5 110   111   108.5 102.5  95    89   83.5
  4 | 114   113   113   112.5 109.5 102.5  93.5  87.5 82
 -6 | 118.5 115.5 114.5 113   108   100.5  92    86   80.5
-16 | 124   119.5 115   111.5 105.5  98    90    84   78.5
-26 | 124   120.5 115.5 110   103.5  96    88.5  82   75.5
-36 | 121   117.5 114   108.5 101    93.5  85.5  78.5 72
-46 | 120   117   112   105.5  97.5  89.5  80.5  73   67
-54 | 119.5 116.5 110   102.5  94    84    73.5  67   63
-60 | 120.5 116.5 108.5  99.5  89.5  77.5  67    63   61.5
-66 | 120   116.5 106.5  94.5  81    69    63    61   60
-71 | 118   114.5 102.5  86.5  72    64    60.5  59.5 59.5
-75 | 115   111    95.5  76.5  66.5  61    59    59   59
-79 | 108   102    80.5  68.5  62.5  59    58    58.5 58.5
-84 |  79.5  74.5  68    63    59    57.5  57.5  58   58.5
"""

_SECTION_ROUNDING_MM = 0.2  # uncertainty due to the rounding of the table

# Nose: height | depth of the midline profile, half width of the section, roundness of its ridge (exponent).
_NOSE_MM = """
 50 | 117.2  9    2    glabella
 42 | 116.2  8.5  2    sellion
 37 | 117.7  8.5  2
 32 | 120.7  9    2.2  nasion between the eyes
 26 | 125.2 10    2.3
 20 | 130   11.2  2.5  rhinion
 14 | 135   12.4  2.7
  8 | 139.2 13.4  3    supratip
  3 | 140.8 14.5  3.2  pronasale
 -1 | 140.2 15    3.4
 -5 | 137   14    3.2
 -8 | 132.3 11    2.6  columella
-10.5 | 127.5 8 2
-12 | 125.7  6.5  2    subnasale
-16 | 124.6  6    2
"""
_ALA_XY_MM, _ALA_HALF_MM, _ALA_HEIGHT_MM = (12.8, -2.6), (5.8, 7.4), 11.0
_ALAR_GROOVE_MM = 0.9
_NOSTRIL_DEPTH_MM = 4.0

# Eyes: a sphere with a cornea, covered by lids.
EYE_CENTRE_MM, EYE_RADIUS_MM = np.array([-31.5, 35.3, 92.5]), 12.2
_CORNEA_RADIUS_MM, _CORNEA_RISE_MM = 5.8, 0.9
_LID_THICKNESS_MM, _CANTHUS_DEPTH_MM = 1.5, 2.5  # largest depth of the inner corner
_FOLD_ABOVE_MM, _FOLD_DEPTH_MM = 4.5, 0.9

# Lips: relief over the sections at shares of the way from the seam to the vermilion's edge, for the upper and
# the lower lip; beyond the edge it falls off over a few millimetres.
_LIP_SHARES = (0, 0.15, 0.4, 0.7, 1.0)
_LIP_UPPER_MM, _LIP_LOWER_MM = (0.8, 3.5, 4.7, 4.9, 3.6), (0.8, 3.2, 5.0, 5.4, 4.0)
_LIP_FALLOFF_MM = (2.8, 3.4)
_SEAM_DEPTH_MM = 1.3
_PULL_REACH_MM = 4.5
_PHILTRUM_MM = (5.0, 0.7, 0.6)  # half distance of the columns, their height, depth of the groove


def mean_vertices() -> np.ndarray:
    """The mean face [V, 3] in metres, mirror symmetric to the last bit."""
    uv = grid_uv().double().numpy()
    left = uv[:, 0] <= 0.5
    radius_mm = _features(uv[left])
    radius_mm = radius_mm + _pull_onto_landmarks(uv, _mirrored(radius_mm))[left]
    return _on_rays(uv, _mirrored(radius_mm)) / 1000


def _mirrored(left: np.ndarray) -> np.ndarray:
    """Mirror values [GRID * (GRID // 2 + 1)] of the image's left half and midline to the whole grid [V]."""
    half = left.reshape(GRID, GRID // 2 + 1)
    return np.concatenate([half, half[:, -2::-1]], 1).reshape(-1)


def _on_rays(uv: np.ndarray, radius: np.ndarray) -> np.ndarray:
    """Points [N, 3] in millimetres at (u, v) [N, 2] and distances [N] from the axis."""
    azimuth = np.radians((uv[:, 0] - 0.5) * 2 * HALF_ANGLE_DEG)
    height = (TOP_M - uv[:, 1] * (TOP_M - BOTTOM_M)) * 1000
    return np.stack([radius * np.sin(azimuth), height, radius * np.cos(azimuth)], -1)


def _features(uv: np.ndarray) -> np.ndarray:
    """Distance from the axis [N] in millimetres at (u, v) [N, 2] with u <= 0.5."""
    azimuth_deg = (0.5 - uv[:, 0]) * 2 * HALF_ANGLE_DEG
    height = (TOP_M - uv[:, 1] * (TOP_M - BOTTOM_M)) * 1000
    radius = _sections(azimuth_deg, height)
    across = radius * np.sin(np.radians(azimuth_deg))  # distance from the midline plane
    radius = radius + _nose(across, height)
    radius = radius - _NOSTRIL_DEPTH_MM * _step(inside_mm("nostrils", uv), -1.2, 1.2)
    radius = radius + _mouth(uv, across, height)
    return _eye(uv, radius)


def _table(text: str) -> np.ndarray:
    rows = [line.replace("|", " ").split() for line in text.strip().splitlines()]
    width = min(len(row) for row in rows)
    return np.array([[float(cell) for cell in row[:width]] for row in rows])


def _sections(azimuth_deg: np.ndarray, height: np.ndarray) -> np.ndarray:
    """Distance from the axis [N] by a smoothing spline of the section depths."""
    rows = _table(_SECTIONS_MM)[::-1]
    azimuths = np.array([*(-a for a in _AZIMUTHS_DEG[:0:-1]), *_AZIMUTHS_DEG])
    depths = np.concatenate([rows[:, :1:-1], rows[:, 1:]], 1)
    smoothing = depths.size * _SECTION_ROUNDING_MM**2
    return RectBivariateSpline(rows[:, 0], azimuths, depths, s=smoothing).ev(height, azimuth_deg)


def _nose(across: np.ndarray, height: np.ndarray) -> np.ndarray:
    """Relief of bridge, tip and wings over the sections."""
    level, depth, half_width, roundness = (PchipInterpolator(*pair) for pair in _nose_columns())
    inside = np.clip(height, level.x[0], level.x[-1])
    rise = np.clip(depth(inside) - _sections(np.zeros_like(height), height), 0, None)
    rise = rise * _step(height, -17, -14) * _step(-height, -54, -46)
    ridge = rise * np.exp(-((across / half_width(inside)) ** roundness(inside)))
    offset = np.stack([across, height], -1) - _ALA_XY_MM
    from_centre = np.linalg.norm(offset / _ALA_HALF_MM, axis=-1)
    wing = _ALA_HEIGHT_MM * np.exp(-(from_centre**3.2))
    groove = _ALAR_GROOVE_MM * np.exp(-(((from_centre - 1.3) / 0.25) ** 2))
    groove = groove * _step(height, -5, 2) * _step(across, 5, 10)
    return _soft_maximum(ridge, wing, 1.2) - _soft_maximum(0, 0, 1.2) - groove


def _nose_columns() -> list[tuple[np.ndarray, np.ndarray]]:
    rows = _table(_NOSE_MM)[::-1]
    return [(rows[:, 0], rows[:, column]) for column in range(4)]


def _mouth(uv: np.ndarray, across: np.ndarray, height: np.ndarray) -> np.ndarray:
    """Relief of the lips, their seam and the philtrum over the sections."""
    u, y = LANDMARK_UV[:, 0], LANDMARKS_M[:, 1] * 1000
    column = np.clip(uv[:, 0], u[48], 0.5)
    top, bottom = CubicSpline(u[48:55], y[48:55])(column), _lower_line(column, u, y)
    seam = (y[60] + (y[[62, 66]].mean() - y[60]) * _step(column, u[48], u[61])) * np.ones_like(column)
    open_share = np.clip(1 - ((0.5 - uv[:, 0]) / (0.5 - u[48])) ** 2, 0, 1) ** 0.8
    above = _lip(height - seam, top - seam, _LIP_UPPER_MM, _LIP_FALLOFF_MM[0])
    below = _lip(seam - height, seam - bottom, _LIP_LOWER_MM, _LIP_FALLOFF_MM[1])
    relief = np.where(height > seam, above, below) * open_share
    relief = relief - _SEAM_DEPTH_MM * _step(inside_mm("mouth", uv), -0.6, 1.0)
    columns, rise, groove = _PHILTRUM_MM
    ridges = rise * np.exp(-(((across - columns) / 2) ** 2)) - groove * np.exp(-((across / 2.8) ** 2))
    return relief + ridges * _step(height, -27, -22) * _step(-height, 11, 14)


def _lower_line(column: np.ndarray, u: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Height [N] of the lower lip's lower edge at u = `column` [N], through landmarks (u, y)."""
    order = [48, 59, 58, 57, 56, 55, 54]
    return CubicSpline(u[order], y[order])(column)


def _lip(
    from_seam: np.ndarray, breadth: np.ndarray, relief: tuple[float, ...], falloff_mm: float
) -> np.ndarray:
    """Relief of one lip [N] at distances from the seam, for the lip's breadth there."""
    breadth = np.maximum(breadth, 1.5)
    inside = PchipInterpolator(_LIP_SHARES, relief)(np.clip(from_seam / breadth, 0, 1))
    return inside * np.exp(-((np.maximum(from_seam - breadth, 0) / falloff_mm) ** 2))


def _eye(uv: np.ndarray, radius: np.ndarray) -> np.ndarray:
    """Distance from the axis [N] with the lids over the eyeball and the eyeball between them."""
    inside = inside_mm("eyes", uv)
    ball = _eyeball(uv)
    above = (LANDMARK_UV[[36, 39], 1].mean() - uv[:, 1]) * UV_SIZE_MM[1]
    lid = ball + _LID_THICKNESS_MM - np.clip(-inside - 3, 0, None) ** 2 * 0.15
    skin = _soft_maximum(radius, lid, 0.67)
    fold = np.exp(-(((-inside - _FOLD_ABOVE_MM) / 1.1) ** 2)) * _step(above, 1, 4)
    skin = skin - _FOLD_DEPTH_MM * fold
    recess = np.clip(skin - ball, 0, _CANTHUS_DEPTH_MM)
    return skin - recess * _step(inside, 0.0, 0.9)


def _eyeball(uv: np.ndarray) -> np.ndarray:
    """Distance from the axis [N] to the eyeball along the rays at (u, v) [N, 2]; 0 where a ray misses it."""
    directions = _on_rays(uv, np.ones(len(uv)))
    height, directions[:, 1] = directions[:, 1].copy(), 0
    to_centre = EYE_CENTRE_MM - np.stack([np.zeros_like(height), height, np.zeros_like(height)], -1)
    along = (to_centre * directions).sum(-1)
    miss2 = (to_centre**2).sum(-1) - along**2
    hit = np.sqrt(np.maximum(EYE_RADIUS_MM**2 - miss2, 0))
    points = directions * (along + hit)[:, None] - to_centre
    from_pupil = np.hypot(points[:, 0], points[:, 1])
    cornea = _CORNEA_RISE_MM * np.clip(1 - (from_pupil / _CORNEA_RADIUS_MM) ** 2, 0, None)
    return np.where(miss2 < EYE_RADIUS_MM**2, along + hit + cornea, 0)


def _pull_onto_landmarks(uv: np.ndarray, radius_mm: np.ndarray) -> np.ndarray:
    """The correction [V] of the radius that brings the mesh's landmarks to their measures."""
    corners, weights = (tensor.numpy() for tensor in landmark_weights())
    wanted = np.hypot(LANDMARKS_M[:, 0], LANDMARKS_M[:, 2]) * 1000
    found = (_on_rays(uv, radius_mm)[corners] * weights[..., None]).sum(1)
    residual = wanted - np.hypot(found[:, 0], found[:, 2])
    landmarks_mm = LANDMARK_UV * UV_SIZE_MM
    strength = np.linalg.solve(_near(landmarks_mm, landmarks_mm), residual)
    return _near(uv * UV_SIZE_MM, landmarks_mm) @ strength


def _near(a_mm: np.ndarray, b_mm: np.ndarray) -> np.ndarray:
    """A Matern kernel [A, B], 1 at distance 0, so that a landmark pulls only its surroundings."""
    distance = np.linalg.norm(a_mm[:, None] - b_mm, axis=-1) * np.sqrt(3) / _PULL_REACH_MM
    return (1 + distance) * np.exp(-distance)


def _soft_maximum(a: np.ndarray | float, b: np.ndarray | float, width_mm: float) -> np.ndarray:
    """A maximum of a and b that is smooth over about `width_mm`."""
    return np.logaddexp(np.divide(a, width_mm), np.divide(b, width_mm)) * width_mm


def _step(value: np.ndarray, start: float, end: float) -> np.ndarray:
    """A smooth step: 0 below `start`, 1 above `end`."""
    share = np.clip((value - start) / (end - start), 0, 1)
    return share * share * (3 - 2 * share)
