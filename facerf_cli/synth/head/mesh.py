"""Small arithmetic that all makers of a head's mesh share.

A simple ear: a shell with a helix rim, an antihelix, a bowl, a tragus and a lobe.

Where hair grows on the scalp: above a hairline that differs from head to head.

The mesh of a head that the synthetic stage photographs, in named parts.
"""

from dataclasses import dataclass

import numpy as np
from scipy.interpolate import CubicSpline

from facerf_cli.face.topology import BOTTOM_M, HALF_ANGLE_DEG, TOP_M
from facerf_cli.synth.head.eyes import capped
from facerf_cli.synth.head.hair_styles import HairStyle


def unit(vectors: np.ndarray) -> np.ndarray:
    """Vectors [..., 3] scaled to length 1; a zero vector stays one."""
    return np.asarray(vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-12))


def smoothstep(value: np.ndarray, start: float = 0.0, end: float = 1.0) -> np.ndarray:
    """0 at `start` and before, 1 at `end` and beyond, smoothly in between."""
    share = np.clip((value - start) / (end - start), 0, 1)
    return np.asarray(share * share * (3 - 2 * share))


def arc_lengths(points: np.ndarray) -> np.ndarray:
    """How far along a line of points [N, C] each of them lies [N], from 0."""
    return np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=-1))])


# Outline in the ear's plane, millimetres: back from the canal, up; round from the front of the helix.
_OUTLINE_MM = """
-6 8 | -5 17 | -1 27 | 7 34.5 | 17 36 | 26 31 | 30.5 21 | 30.5 9 | 27 -3 | 21.5 -14 | 15.5 -22 | 8 -27 | 0 -26
-5 -20 | -7.5 -11 | -7.5 -1
"""
_CENTRE_MM = np.array([6.0, 2.0])
_RINGS, _SPOKES = 34, 112
_OUT_DEG, _BACK_TILT_DEG, _IN_DEG = 27.0, 10.0, 4.0
_THICKNESS_MM = 3.2
_SINK_MM = 6.0  # of the front rim into the cheek
_HOLLOW_MM, _HOLLOW_HALF_MM = np.array([7.0, 1.0]), np.array([9.0, 11.0])
_BEND_MM = 3.0  # of the ear's upper and lower end, toward the head
_ROOT_MM = 20.0  # how far the ear's back reaches into the head


def ear() -> tuple[np.ndarray, np.ndarray]:
    """A closed surface: vertices [V, 3] in millimetres from the canal's mouth and triangles [F, 3].

    Of the picture's right side, x out of the head, y up, z forward.
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


def hollow_mm(points: np.ndarray) -> np.ndarray:
    """How far [N] the head gives way to the ear's bowl at points [N, 3] from the canal's mouth (as `ear`)."""
    offset = np.stack([-points[:, 2], points[:, 1]], -1) - _HOLLOW_MM
    from_centre = np.linalg.norm(offset / _HOLLOW_HALF_MM, axis=-1)
    return np.where(points[:, 0] > -30, _ROOT_MM * np.exp(-(from_centre**4)), 0)


def _outline(turn: np.ndarray) -> np.ndarray:
    text = _OUTLINE_MM.strip().replace("\n", " | ")
    points = np.array([[float(x) for x in cell.split()] for cell in text.split("|")])
    points = np.concatenate([points, points[:1]])
    length = arc_lengths(points)
    return CubicSpline(length / length[-1], points, bc_type="periodic")(turn)


def _relief(rho: np.ndarray, plane: np.ndarray) -> np.ndarray:
    """Height [R, S] of the ear's face above its plane."""
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
    """Points of the ear's plane, turned out of the head and tilted back."""
    out, tilt = np.radians(_OUT_DEG), np.radians(_BACK_TILT_DEG)
    back = np.array([np.sin(out), 0, -np.cos(out)])
    normal = np.array([np.cos(out), 0, np.sin(out)])
    up = np.array([0.0, 1, 0])
    back, up = back * np.cos(tilt) - up * np.sin(tilt), up * np.cos(tilt) + back * np.sin(tilt)
    lean = np.radians(_IN_DEG)  # the upper part stands off a little more
    up = up * np.cos(lean) + normal * np.sin(lean)
    normal = np.cross(up, back) * -1
    return plane[..., :1] * back + plane[..., 1:] * up + height[..., None] * normal


# The hairline: height in metres at an azimuth in degrees from the nose, on both sides. `forehead` and
# `recession` are added to the first ones; the ear lies between 75 and 100 degrees.
_LINE_DEG = (0, 20, 36, 46, 54, 60, 64, 67, 72, 75, 85, 95, 103, 112, 130, 150, 180)
_LINE_M = (0, 0.001, 0.004, -0.003, -0.022, -0.040, -0.058, -0.076, -0.078)
_LINE_EAR_M = (0.046, 0.048, 0.043, 0.022, -0.018, -0.052, -0.066, -0.068)
_RECEDES = (0.0, 0.35, 1.0, 1.0, 0.6, 0.3, 0.1, 0, 0)  # share of `recession` at the first azimuths
_MEAN_FOREHEAD_M = 0.096


def scalp_margin_m(points: np.ndarray, style: HairStyle) -> np.ndarray:
    """How far [...] above the style's hairline points [..., 3] of the skin lie, in metres of height."""
    azimuth = np.abs(np.degrees(np.arctan2(points[..., 0], points[..., 2])))
    first = np.array(_LINE_M) + style.forehead_mm / 1000 + np.array(_RECEDES) * style.recession_mm / 1000
    fixed = np.array(_LINE_M) + _MEAN_FOREHEAD_M  # temples and sideburns stay where they are
    first = np.where(np.array(_LINE_DEG[: len(first)]) > 50, fixed, first)
    return points[..., 1] - np.interp(azimuth, _LINE_DEG, [*first, *_LINE_EAR_M])


def scalp_cover(uv: np.ndarray, style: HairStyle) -> np.ndarray:
    """Share [...] in 0..1 of the skin at extended chart (u, v) [..., 2] that hair grows on.

    A skin picture stained with it hides the scalp that shows between the wisps.
    """
    azimuth = np.radians((uv[..., 0] - 0.5) * 2 * HALF_ANGLE_DEG)
    y = TOP_M - uv[..., 1] * (TOP_M - BOTTOM_M)
    points = np.stack([np.sin(azimuth), y, np.cos(azimuth)], -1)
    cover = np.clip(scalp_margin_m(points, style) / 0.008 + 0.3, 0, 1) * (style.wisps > 0)
    return cover * np.where(np.abs(azimuth) < np.pi, 1 - 0.7 * style.thinning * (y > 0.1), 0)


PARTS = ("skin", "eye", "mouth", "teeth", "cloth", "hair", "frame")  # of HeadMesh.part, by index


@dataclass(frozen=True, eq=False)
class HeadMesh:
    """A head with all that it wears; head frame (DESIGN), metres, float32.

    vertices, normals (unit) [V, 3]; triangles [F, 3] int64, counter-clockwise seen from outside, each within
    one part; part [V] uint8, an index into `PARTS`; uv [V, 2] in the part's own texture (skin: the chart of
    `face.topology`, which may be left on all sides; row v = 0 at the top); tangents [V, 3] unit along a
    strand of hair, zero elsewhere.
    """

    vertices: np.ndarray
    normals: np.ndarray
    triangles: np.ndarray
    part: np.ndarray
    uv: np.ndarray
    tangents: np.ndarray


def joined(*meshes: HeadMesh) -> HeadMesh:
    """One mesh of several."""
    offsets = np.cumsum([0, *(len(mesh.vertices) for mesh in meshes[:-1])])
    return HeadMesh(
        vertices=np.concatenate([mesh.vertices for mesh in meshes]),
        normals=np.concatenate([mesh.normals for mesh in meshes]),
        triangles=np.concatenate([m.triangles + offset for m, offset in zip(meshes, offsets, strict=True)]),
        part=np.concatenate([mesh.part for mesh in meshes]),
        uv=np.concatenate([mesh.uv for mesh in meshes]),
        tangents=np.concatenate([mesh.tangents for mesh in meshes]),
    )


def strandless(
    part: str, vertices: np.ndarray, normals: np.ndarray, triangles: np.ndarray, uv: np.ndarray
) -> HeadMesh:
    """One part without strands: vertices and normals [N, 3], of any length, triangles [F, 3], uv [N, 2]."""
    normals = unit(normals)
    return HeadMesh(
        vertices=vertices.astype(np.float32),
        normals=normals.astype(np.float32),
        triangles=triangles.astype(np.int64),
        part=np.full(len(vertices), PARTS.index(part), np.uint8),
        uv=uv.astype(np.float32),
        tangents=np.zeros((len(vertices), 3), np.float32),
    )
