"""Inside of an open mouth: a dark bag behind the lips, teeth, gums and tongue, in millimetres."""

from collections.abc import Callable

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation

from facerf_cli.face.topology import LANDMARKS_M
from facerf_cli.synth import tables_of
from facerf_cli.synth.head.mesh import arc_lengths, capped, ring_triangles, unit

_TABLES = tables_of(__file__)
_ARCH_HALF_MM, _ARCH_DEPTH_MM = 27.0, 38.0  # half width and depth of the arch of a row
_EDGE_MM = np.array([0.0, -35.0, 117.0])  # edge of the upper incisors in the average head
_OVERLAP_MM, _OVERJET_MM = 2.0, 2.2  # of the upper incisors, below and in front of the lower ones
_HINGE_MM = np.array([0.0, 12.0, 25.0])  # axis of the jaw
_STEADY = (27, 28, 29, 30, 33, 36, 39, 42, 45)  # landmarks that expressions hardly move
_LIP_MM = 0.8  # between the inner rim of the lips and the teeth
_CHIN_DOUBT_MM = 4.0  # a person's chin may be this much longer than the landmarks suggest
_TOOTH_RINGS, _TOOTH_SEGMENTS = 9, 16
_GUM_RINGS, _GUM_SEGMENTS = 41, 16
_GUM_UP_MM, _GUM_HALF_MM, _GUM_BEHIND_MM = 13.0, np.array([4.6, 6.0]), 3.6  # relative to the incisors' edge
_TONGUE_MM, _TONGUE_HALF_MM = np.array([0, -6.0, -31.0]), np.array([18.0, 6.5, 26.0])  # centre, half size


def bag(rim: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Build a bag behind the lips' inner rim [N, 3] (in order): vertices, triangles seen from inside, uv."""
    centre = rim.mean(0)
    offset = rim - centre
    reach = np.maximum(np.abs(offset[:, :2]).max(0), 1.0)
    direction = unit(offset[:, :2] / reach)
    rings = []
    flat = rim[:, 2].mean()
    for behind, wider, taller in _TABLES["bag_mm"]:
        ring = rim.copy()
        ring[:, :2] += direction * [wider, taller]
        share = min(behind / 10, 1)
        ring[:, 2] += share * np.minimum(flat - rim[:, 2], 0) - behind
        rings.append(ring)
    end = centre - [0, 0, 45]
    vertices = np.concatenate([*rings, end[None]])
    count = len(rim)
    sides = ring_triangles(len(rings), count)
    last = (len(rings) - 1) * count + np.arange(count)
    cap = np.stack([last, np.full(count, len(vertices) - 1), np.roll(last, -1)], -1)
    turn = np.arange(count) / count
    uv = [np.stack([turn, np.full(count, k / len(rings))], -1) for k in range(len(rings))]
    return vertices, np.concatenate([sides, cap])[:, ::-1], np.concatenate([*uv, [[0.5, 1]]])


def teeth(landmarks_mm: np.ndarray, rim: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Both rows of teeth behind the rim of the lips [N, 3]: vertices [V, 3], triangles [F, 3], uv [V, 2]."""
    rows = [_row(_TABLES["upper_teeth_mm"], 1.0), _row(_TABLES["lower_teeth_mm"], -1.0)]
    placed = [place(row) for place, row in zip(_placements(landmarks_mm, rim), rows, strict=True)]
    one = capped(_TOOTH_RINGS, _TOOTH_SEGMENTS)
    count = _TOOTH_RINGS * _TOOTH_SEGMENTS
    number = 2 * 2 * len(_TABLES["upper_teeth_mm"])
    triangles = (one + count * np.arange(number)[:, None, None]).reshape(-1, 3)
    return np.concatenate(placed), triangles, np.tile(_ring_uv(_TOOTH_RINGS, _TOOTH_SEGMENTS), (number, 1))


def gums_and_tongue(
    landmarks_mm: np.ndarray, rim: np.ndarray
) -> list[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Build the gums of both rows, and the tongue behind the lower one, each in the form of `teeth`."""
    upper, lower = _placements(landmarks_mm, rim)
    triangles, uv = capped(_GUM_RINGS, _GUM_SEGMENTS), _ring_uv(_GUM_RINGS, _GUM_SEGMENTS)
    gums = [(upper(_ridge(1.0)), triangles[:, ::-1], uv), (lower(_ridge(-1.0)), triangles, uv)]
    angle, turn = np.meshgrid(
        np.linspace(0, np.pi, _GUM_RINGS), np.arange(_GUM_SEGMENTS) / _GUM_SEGMENTS, indexing="ij"
    )
    around = 2 * np.pi * turn
    ball = np.stack([np.sin(angle) * np.cos(around), np.sin(angle) * np.sin(around), np.cos(angle)], -1)
    tongue = ball.reshape(-1, 3) * _TONGUE_HALF_MM
    tongue[:, 1] -= (
        0.012 * (tongue[:, 2] - _TONGUE_HALF_MM[2] * 0.2) ** 2 * (tongue[:, 2] > 0.2 * _TONGUE_HALF_MM[2])
    )
    tongue[:, 1] -= 1.6 * np.exp(-((tongue[:, 0] / 3.0) ** 2)) * (tongue[:, 1] > 1e-6)
    return [*gums, (lower(tongue + _TONGUE_MM), triangles, uv)]


def _placements(
    landmarks_mm: np.ndarray, rim: np.ndarray
) -> tuple[Callable[[np.ndarray], np.ndarray], Callable[[np.ndarray], np.ndarray]]:
    """Two functions that map points [V, 3] from the frame of the upper and of the lower row into the mouth.

    The origin of a row's frame is the middle of the edge of its incisors.
    """
    scale, turn, shift = _skull(landmarks_mm)
    drop = _jaw(landmarks_mm, scale, turn, shift)
    above = rim[:, 1] > rim[:, 1].mean()

    def upper(points: np.ndarray) -> np.ndarray:
        return (points + _EDGE_MM) @ turn.T * scale + shift

    def lower(points: np.ndarray) -> np.ndarray:
        closed = points * [0.94, 1, 0.94] + _EDGE_MM + [0, _OVERLAP_MM, -_OVERJET_MM]
        return drop(closed) @ turn.T * scale + shift

    backs = [
        _too_near(place(np.zeros((1, 3))), lip) for place, lip in ((upper, rim[above]), (lower, rim[~above]))
    ]
    return (lambda points: upper(points) - [0, 0, backs[0]]), (
        lambda points: lower(points) - [0, 0, backs[1]]
    )


def _skull(landmarks_mm: np.ndarray) -> tuple[float, np.ndarray, np.ndarray]:
    """Scale, rotation [3, 3] and shift [3] from the average head to this one."""
    a, b = LANDMARKS_M[list(_STEADY)] * 1000, landmarks_mm[list(_STEADY)]
    turn, _ = Rotation.align_vectors(b - b.mean(0), a - a.mean(0))
    matrix = turn.as_matrix()
    scale = float(np.linalg.norm(b - b.mean(0)) / np.linalg.norm(a - a.mean(0)))
    return scale, matrix, b.mean(0) - scale * matrix @ a.mean(0)


def _jaw(
    landmarks_mm: np.ndarray, scale: float, turn: np.ndarray, shift: np.ndarray
) -> Callable[[np.ndarray], np.ndarray]:
    """Return the rotation of the jaw around its hinge that lowers chin and lower lip to where they are."""
    own_mm = (landmarks_mm - shift) @ turn / scale
    chin = LANDMARKS_M[8, 1] * 1000 - own_mm[8, 1]
    parted = own_mm[[61, 62, 63], 1].mean() - own_mm[[67, 66, 65], 1].mean() - 2
    drop = np.clip(min(chin + _CHIN_DOUBT_MM, parted), 0, 40)
    angle = drop / np.linalg.norm((_EDGE_MM - _HINGE_MM)[1:])
    jaw, aside = Rotation.from_rotvec([angle, 0, 0]), np.array([own_mm[6:11, 0].mean(), 0, 0])
    return lambda points: _HINGE_MM + jaw.apply(points - _HINGE_MM) + aside


def _too_near(row: np.ndarray, lip: np.ndarray) -> float:
    """Return how far a row must move back to stay behind the inner rim [N, 3] of a lip."""
    middle = lip[np.abs(lip[:, 0] - lip[:, 0].mean()) < 0.25 * np.ptp(lip[:, 0])]
    front = row[:, 2].max()
    return float(max(front + _LIP_MM - middle[:, 2].min(), 0))


def _arch() -> tuple[CubicSpline, float]:
    """Half the arch of a row: a spline of (x, z) over the arc length from the midline, and its length."""
    along = np.linspace(0, np.pi / 2, 200)
    arch = np.stack([np.sin(along) * _ARCH_HALF_MM, np.cos(along) * _ARCH_DEPTH_MM - _ARCH_DEPTH_MM], -1)
    length = arc_lengths(arch)
    return CubicSpline(length, arch), float(length[-1])


def _ridge(up: float) -> np.ndarray:
    """Build a gum [V, 3] along the whole arch, with tapered ends; `up` is 1 for the upper row, or -1."""
    curve, length = _arch()
    along = np.linspace(-1, 1, _GUM_RINGS)
    at, slope = curve(np.abs(along) * length * 0.96), curve(np.abs(along) * length * 0.96, 1)
    side = np.where(along < 0, -1.0, 1.0)
    centre = np.stack([side * at[:, 0], np.full(_GUM_RINGS, up * _GUM_UP_MM), at[:, 1]], -1)
    back = unit(np.stack([side * slope[:, 1], np.zeros(_GUM_RINGS), -slope[:, 0]], -1))
    taper = np.sqrt(np.clip(1 - (np.abs(along) - 0.9).clip(0) ** 2 / 0.01, 0, 1))
    around = np.arange(_GUM_SEGMENTS) / _GUM_SEGMENTS * 2 * np.pi
    ring = np.stack([np.cos(around) * _GUM_HALF_MM[0], np.sin(around) * _GUM_HALF_MM[1]], -1)
    points = centre[:, None] + back[:, None] * (_GUM_BEHIND_MM + taper[:, None, None] * ring[:, :1])
    points[..., 1] += up * taper[:, None] * ring[:, 1]
    return points.reshape(-1, 3)


def _row(sizes_mm: list[list[float]], up: float) -> np.ndarray:
    """Build a row of teeth [V, 3], its incisors' edge at the origin; `up` is 1 if roots point up, or -1."""
    curve, _ = _arch()
    widths = [width for width, _ in sizes_mm]
    centres = np.cumsum(widths) - np.array(widths) / 2
    sides = []
    for centre, (width, height) in zip(centres, sizes_mm, strict=True):
        x, z = curve(centre)
        tangent = curve(centre, 1)
        angle = np.arctan2(-tangent[1], tangent[0])
        tooth = _tooth(width, height, 6.0 if centre < 20 else 9.0) * [1, up, 1]
        turned = Rotation.from_rotvec([0, angle, 0]).apply(tooth)
        sides.append(turned + np.array([x, 0, z]))
    right = np.concatenate(sides)
    mirrored = right.reshape(-1, _TOOTH_RINGS, _TOOTH_SEGMENTS, 3) * [-1, 1, 1]
    if up < 0:
        right = right.reshape(mirrored.shape)[:, :, ::-1].reshape(-1, 3)
    else:
        mirrored = mirrored[:, :, ::-1]
    return np.concatenate([mirrored.reshape(-1, 3), right])


def _tooth(width: float, height: float, depth: float) -> np.ndarray:
    """Build a rounded block [V, 3] with its front at z = 0 and its edge at y = 0."""
    level = np.linspace(0, 1, _TOOTH_RINGS)
    around = np.arange(_TOOTH_SEGMENTS) / _TOOTH_SEGMENTS * 2 * np.pi
    cos, sin = np.cos(around), np.sin(around)
    square = np.stack([np.sign(cos) * np.abs(cos) ** 0.5, np.sign(sin) * np.abs(sin) ** 0.5], -1)
    bulge = np.sin(np.pi * np.clip(level, 0.0, 1)) ** 0.25
    narrow = 1 - 0.16 * level**2
    x = square[None, :, 0] * (width * 0.49 * bulge * narrow)[:, None]
    thin = 0.45 + 0.55 * np.clip(level * 1.6, 0, 1)
    z = square[None, :, 1] * (depth / 2 * bulge * thin)[:, None]
    front = -depth / 2 * thin[:, None] - 0.5 * (1 - bulge)[:, None]
    y = np.broadcast_to((height * (1 - np.cos(np.pi * level)) / 2)[:, None], x.shape)
    return np.stack([x, y, z + front], -1).reshape(-1, 3)


def _ring_uv(rings: int, segments: int) -> np.ndarray:
    """uv [rings * segments, 2] of a surface of rings."""
    return np.stack(np.meshgrid(np.linspace(0, 1, segments), np.linspace(0, 1, rings)), -1).reshape(-1, 2)
