"""A simple ear: a shell with a helix rim, an antihelix, a bowl, a tragus and a lobe.

The ear is modelled in its own plane: `a` back from the mouth of the ear canal, `b` up, in millimetres.
"""

import numpy as np
from scipy.interpolate import CubicSpline

from facerf_cli.synth.head.mesh import arc_lengths, capped, smoothstep

# Outline in the ear's plane, (a, b) in millimetres, starting at the front of the helix.
_OUTLINE_MM = """
-6 8 | -5 17 | -1 27 | 7 34.5 | 17 36 | 26 31 | 30.5 21 | 30.5 9 | 27 -3 | 21.5 -14 | 15.5 -22 | 8 -27 | 0 -26
-5 -20 | -7.5 -11 | -7.5 -1
"""
_CENTRE_MM = np.array([6.0, 2.0])  # rings of vertices shrink from the outline to this point
_RINGS, _SPOKES = 34, 112
_OUT_DEG, _BACK_TILT_DEG, _IN_DEG = 27.0, 10.0, 4.0  # orientation of the ear's plane against the head
_THICKNESS_MM = 3.2
_SINK_MM = 6.0  # depth of the front rim inside the cheek, so that no gap shows
_HOLLOW_MM, _HOLLOW_HALF_MM = np.array([7.0, 1.0]), np.array([9.0, 11.0])  # centre and half size
_BEND_MM = 3.0  # bend of the upper and lower end toward the head
_ROOT_MM = 20.0  # depth of the ear's back inside the head


def ear_surface() -> tuple[np.ndarray, np.ndarray]:
    """Closed surface of the ear on the right side of the image: vertices [V, 3] and triangles [F, 3].

    Vertices are in millimetres from the mouth of the ear canal: x out of the head, y up, z forward.
    """
    rho = np.concatenate([np.linspace(0, 0.8, _RINGS // 2, endpoint=False), np.linspace(0.8, 1, _RINGS // 2)])
    turn = np.arange(_SPOKES) / _SPOKES
    rim = _outline(turn)  # [S, 2]
    plane = _CENTRE_MM + rho[:, None, None] * (rim - _CENTRE_MM)  # [R, S, 2]
    front = _relief(rho[:, None], plane)
    edge = np.sqrt(np.clip(1 - ((rho[:, None] - 0.86) / 0.14).clip(0, 1) ** 2, 0, 1))
    thickness = _THICKNESS_MM * edge
    attached = smoothstep(-rho[:, None], -0.92, -0.25)
    forward = smoothstep(-plane[..., 0], -12, 5)
    back = front - thickness - _ROOT_MM * np.maximum(attached, 0) * np.ones_like(front)
    front = front - _SINK_MM * forward * smoothstep(rho[:, None], 0.7, 1.0)
    back = back - _SINK_MM * forward
    sheet = np.concatenate([_placed(plane, front), _placed(plane, back)[-2::-1]])
    return sheet.reshape(-1, 3), capped(len(sheet), _SPOKES)[:, ::-1]


def ear_hollow_mm(points: np.ndarray) -> np.ndarray:
    """Depth [N] by which the skin of the head is pushed in at points [N, 3], to make room for the ear's bowl.

    Points are in the coordinates of `ear_surface`.
    """
    offset = np.stack([-points[:, 2], points[:, 1]], -1) - _HOLLOW_MM
    from_centre = np.linalg.norm(offset / _HOLLOW_HALF_MM, axis=-1)
    return np.where(points[:, 0] > -30, _ROOT_MM * np.exp(-(from_centre**4)), 0)


def _outline(turn: np.ndarray) -> np.ndarray:
    """Points [S, 2] of the outline at fractions [S] of its length."""
    text = _OUTLINE_MM.strip().replace("\n", " | ")
    points = np.array([[float(x) for x in cell.split()] for cell in text.split("|")])
    points = np.concatenate([points, points[:1]])
    length = arc_lengths(points)
    return CubicSpline(length / length[-1], points, bc_type="periodic")(turn)


def _relief(rho: np.ndarray, plane: np.ndarray) -> np.ndarray:
    """Height [R, S] of the ear's outer side above its plane: a sum of bumps and dents."""
    a, b = plane[..., 0], plane[..., 1]
    lobe = smoothstep(-b, 10, 20)
    rear = smoothstep(a, -3, 6)
    above = np.maximum(rear, smoothstep(b, 10, 20))
    helix = 3.4 * np.exp(-(((rho - 0.90) / 0.085) ** 2)) * above * (1 - 0.8 * lobe)
    scapha = -1.6 * np.exp(-(((rho - 0.74) / 0.07) ** 2)) * above * (1 - lobe)
    antihelix = 2.6 * np.exp(-(((rho - 0.57) / 0.10) ** 2)) * smoothstep(a, 2, 10) * (1 - lobe)
    bowl = -11.0 * np.exp(-((((a - 5.5) / 7.5) ** 2 + ((b + 0.5) / 10.0) ** 2) ** 1.6))
    crus = 4.0 * np.exp(-(((b - 5.5 - 0.25 * a) / 2.2) ** 2)) * smoothstep(-a, -9, 2) * smoothstep(a, -9, -2)
    fossa = -2.0 * np.exp(-(((a - 11) / 6) ** 2 + ((b - 22) / 6) ** 2))
    tragus = 6.5 * np.exp(-((((a + 4.0) / 3.2) ** 2 + ((b + 2.0) / 6.0) ** 2) ** 1.5))
    antitragus = 2.6 * np.exp(-(((a - 6) / 4.5) ** 2 + ((b + 13) / 2.8) ** 2))
    plump = 1.5 * np.exp(-(((a - 6) / 9) ** 2 + ((b + 21) / 6) ** 2))
    turned = -2.6 * np.clip((rho - 0.9) / 0.1, 0, 1) ** 2
    bend = -_BEND_MM * ((b - 6) / 30) ** 2
    return bend + helix + scapha + antihelix + bowl + crus + fossa + tragus + antitragus + plump + turned


def _placed(plane: np.ndarray, height: np.ndarray) -> np.ndarray:
    """Points [R, S, 3] at (a, b) [R, S, 2] and a height above the plane, which turns out and tilts back."""
    out, tilt = np.radians(_OUT_DEG), np.radians(_BACK_TILT_DEG)
    back = np.array([np.sin(out), 0, -np.cos(out)])
    normal = np.array([np.cos(out), 0, np.sin(out)])
    up = np.array([0.0, 1, 0])
    back, up = back * np.cos(tilt) - up * np.sin(tilt), up * np.cos(tilt) + back * np.sin(tilt)
    lean = np.radians(_IN_DEG)  # the upper part stands off a little more
    up = up * np.cos(lean) + normal * np.sin(lean)
    normal = np.cross(up, back) * -1
    return plane[..., :1] * back + plane[..., 1:] * up + height[..., None] * normal
