"""Eyeballs behind the lids of any face, in millimetres."""

import numpy as np

from facerf_cli.synth.head.mesh import capped

RADIUS_MM = 12.0
_CORNEA_RISE_MM, _CORNEA_HALF_DEG = 0.9, 30.0  # bulge of the cornea over the ball, and its half angle
_LID_MM = 1.5  # from the ball to the outer edge of the lid
_CLEARANCE_MM = 0.5  # minimal gap between the ball, without its cornea, and the skin
_PRIOR_MM = np.array([4.0, 4.0, 8.0])  # standard deviation of the centre around its usual place
_USUAL_MM = np.array([0.0, 1.0, -9.0])  # usual centre from the middle between the corners of the lids
_ITERATIONS = 8
_RINGS_DEG = np.array([0, 2, *range(4, 92, 3), 96, 103, 112, 125, 140, 160, 180.0])  # from the gaze axis
_SEGMENTS = 64  # of a ring


def fitted_centre(margin: np.ndarray, skin: np.ndarray) -> np.ndarray:
    """Fit the centre [3] of an eyeball to the margin of its lids [N, 3] (in the order of the outline).

    The ball keeps a clearance to all points of `skin` [M, 3] around the eye.
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
    """Vertices [V, 3], triangles [F, 3] and uv [V, 2] of an eyeball that looks along the gaze."""
    angle, turn = np.meshgrid(
        np.radians(_RINGS_DEG), np.arange(_SEGMENTS) / _SEGMENTS * 2 * np.pi, indexing="ij"
    )
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
    return vertices, capped(len(_RINGS_DEG), _SEGMENTS), uv
