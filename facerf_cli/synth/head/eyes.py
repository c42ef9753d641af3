"""Eyeballs behind the lids of any face.

Lips and lids that meet: a linear model leaves them open, or lets them cross, by another width for each.
"""

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from facerf_cli.face.topology import LANDMARK_UV

RADIUS_MM = 12.0
_CORNEA_RISE_MM, _CORNEA_HALF_DEG = 0.9, 30.0
_LID_MM = 1.5  # from the ball to the lid's outer edge
_CLEARANCE_MM = 0.5  # of skin before the ball, at least; the cornea needs more
_PRIOR_MM = np.array([4.0, 4.0, 8.0])  # by how much the lids' shape may move the ball from its usual place
_ITERATIONS = 8
_USUAL_MM = np.array([0.0, 1.0, -9.0])  # centre from the middle between the lids' corners
_RINGS, _SEGMENTS = np.array([0, 2, *range(4, 92, 3), 96, 103, 112, 125, 140, 160, 180.0]), 64


def fitted_centre(margin: np.ndarray, skin: np.ndarray) -> np.ndarray:
    """Centre [3] of the ball that the lids' margin [N, 3] (mm, in the outline's order) lies upon.

    Not nearer than a clearance to any point of `skin` [M, 3] around the eye.
    """
    corners = margin[[0, len(margin) // 2]]
    usual = corners.mean(0) + _USUAL_MM
    along = corners[1] - corners[0]
    share = (margin - corners[0]) @ along / (along @ along)
    middle = margin[(share > 0.2) & (share < 0.8)]
    centre = usual.copy()
    for _ in range(_ITERATIONS):
        offset = centre - middle
        distance = np.linalg.norm(offset, axis=-1)
        slope = offset / distance[:, None]
        trust = len(middle) / _PRIOR_MM**2
        step = slope.T @ (distance - RADIUS_MM - _LID_MM) + trust * (centre - usual)
        centre = centre - np.linalg.solve(slope.T @ slope + np.diag(trust), step)
    for _ in range(_ITERATIONS):
        depth = RADIUS_MM + _CLEARANCE_MM - np.linalg.norm(skin - centre, axis=-1)
        if depth.max() <= 0:
            break
        centre = centre - [0, 0, depth.max()]
    return centre


def eyeball(centre: np.ndarray, gaze_deg: tuple[float, float]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Vertices [V, 3] in millimetres, triangles [F, 3] and uv [V, 2] of a ball that looks along the gaze."""
    angle, turn = np.meshgrid(np.radians(_RINGS), np.arange(_SEGMENTS) / _SEGMENTS * 2 * np.pi, indexing="ij")
    share = np.clip(angle / np.radians(_CORNEA_HALF_DEG), 0, 1)
    radius = RADIUS_MM + _CORNEA_RISE_MM * (1 - share**2) ** 2
    local = (
        np.stack([np.sin(angle) * np.cos(turn), np.sin(angle) * np.sin(turn), np.cos(angle)], -1)
        * radius[..., None]
    )
    azimuth, elevation = np.radians(gaze_deg)
    forward = np.array(
        [np.cos(elevation) * np.sin(azimuth), np.sin(elevation), np.cos(elevation) * np.cos(azimuth)]
    )
    side = np.array([np.cos(azimuth), 0, -np.sin(azimuth)])
    up = np.cross(forward, side)
    vertices = centre + local.reshape(-1, 3) @ np.stack([side, up, forward])
    reach = np.minimum(angle / (np.pi / 2), 1)
    uv = 0.5 + 0.5 * np.stack([reach * np.cos(turn), -reach * np.sin(turn)], -1).reshape(-1, 2)
    return vertices, capped(len(_RINGS), _SEGMENTS), uv


def ring_triangles(rings: int, segments: int) -> np.ndarray:
    """Triangles [F, 3] between closed rings of vertices.

    They are counter-clockwise for a viewer who sees each ring so, and the next ring behind and around it.
    """
    ring, segment = np.meshgrid(np.arange(rings - 1), np.arange(segments), indexing="ij")
    a = ring * segments + segment
    b = ring * segments + (segment + 1) % segments
    c, d = a + segments, b + segments
    return np.stack([a, c, d, a, d, b], -1).reshape(-1, 3)


def capped(rings: int, segments: int) -> np.ndarray:
    """`ring_triangles` where the first and the last ring are one point each, of which one vertex is used."""
    faces = ring_triangles(rings, segments)
    last = (rings - 1) * segments
    faces = np.where(faces < segments, 0, np.where(faces >= last, last, faces))
    a, b, c = faces.T
    return faces[(a != b) & (b != c) & (c != a)]


_COLUMNS = 33  # across a slit, at which its width is read
_LIP_OVERLAP_M, _LID_OVERLAP_M = 0.0004, 0.0008  # closed edges cross by this: subdivision rounds them off
_LIP_REACH_M, _LID_REACH_M = 0.006, 0.004  # what yields around a slit: one standard deviation
_LIP_MARGIN_UV = np.array([0, 0.04])  # where the edges of the lips are looked for
_LID_RINGS = 5  # from the inner border of the lids, among which their edges are
_INNER_LIPS_UV = LANDMARK_UV[60:68]


@dataclass(frozen=True, eq=False)
class Slit:
    """A slit between an upper and a lower edge.

    upper, lower: vertex ids of the edges from left to right; weight [N] in [-1, 1]: how far each vertex goes
    along when the slit opens by 1, up (positive: the upper side) or down; overlap_m: of closed edges.
    """

    upper: np.ndarray
    lower: np.ndarray
    weight: np.ndarray
    overlap_m: float

    def closing(self, shape: np.ndarray) -> np.ndarray:
        """Offsets along y [N] that bring the edges of a head [N, 3] together, or part crossed ones."""
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
    order = np.argsort(x)
    return x[order], y[order]


def eye_slit(mean: np.ndarray, shut: np.ndarray, loop: np.ndarray, triangles: np.ndarray) -> Slit:
    """The slit between the lids around a loop of the skin's border [K]; shut [N, 3]: the mean with a blink.

    The lids' edges are those of the rings around the loop that are nearest to each other when shut.
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
    """A loop [K] of vertices, those next to it, those next to them and so on."""
    rings, seen = [loop], np.zeros(triangles.max() + 1, bool)
    for _ in range(_LID_RINGS):
        seen[rings[-1]] = True
        around = np.unique(triangles[seen[triangles].any(-1)])
        rings.append(around[~seen[around]])
    return rings


def lip_slit(mean: np.ndarray, uv: np.ndarray, skin: np.ndarray, soft: np.ndarray, jaw: np.ndarray) -> Slit:
    """The slit between the lips; jaw [N, 3] is what opens it, soft the ids of skin and mouth."""
    low, high = _INNER_LIPS_UV.min(0) - _LIP_MARGIN_UV, _INNER_LIPS_UV.max(0) + _LIP_MARGIN_UV
    lips = skin[((uv[skin] > low) & (uv[skin] < high)).all(-1)]
    fall = np.linalg.norm(jaw, axis=-1)
    above = fall < fall[lips].max() / 2
    edges = _edges(mean, lips, above, mean[lips, 0].min(), mean[lips, 0].max())
    return Slit(*edges, _weight(mean, *edges, soft, above, _LIP_REACH_M, 0.5), _LIP_OVERLAP_M)


def _edges(
    mean: np.ndarray, ids: np.ndarray, above: np.ndarray, left: float, right: float
) -> tuple[np.ndarray, np.ndarray]:
    """The lowest of the vertices above, and the highest of those below, in columns from left to right."""
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
    """How far vertices go along [N], less the farther from their edge; the upper side takes `share`."""
    weight = np.zeros(len(mean))
    for edge, side, part in ((upper, above, share), (lower, ~above, share - 1)):
        mine = movable[side[movable]]
        away, _ = cKDTree(mean[edge]).query(mean[mine])
        weight[mine] = part * np.exp(-((away / reach_m) ** 2) / 2)
    return weight
