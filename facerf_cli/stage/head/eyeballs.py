"""Eyeballs behind the lids of any face."""

import numpy as np

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
