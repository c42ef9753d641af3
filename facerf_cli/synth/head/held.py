"""Things that hide parts of a face or hang beside it: a hand at cheek or chin, a microphone, earrings."""

import numpy as np
from scipy.spatial.transform import Rotation

from facerf_cli.portrait.classes import class_index
from facerf_cli.synth.head.hull import hull_of
from facerf_cli.synth.head.makehuman import packed_mesh
from facerf_cli.synth.head.mesh import HeadMesh, cloth_like, joined, ring_surface, unit
from facerf_cli.synth.head.subdivision import loop_step

_AROUND = 24  # vertices around arms, microphones and rings
_HAND_DIRECTION = unit(np.array([0.72, -0.66, 0.2]))  # of the packed hand's fingers
_WRIST_M = 0.035  # half width of the wrist
_ARM_M = 0.3  # length of the forearm
_SKIN_UV = (0.5, 1.2)  # a plain place of the skin's texture


def draw_hand(head: HeadMesh, random: np.random.Generator) -> HeadMesh:
    """Draw a hand whose fingers touch cheek or chin, with the sleeve of its arm."""
    vertices, faces = packed_mesh("hand")
    step, faces = loop_step(faces, len(vertices))
    vertices = step @ vertices
    side = float(random.choice([-1, 1]))
    fingers = unit(np.array([-0.3 * side, 1.0, random.uniform(-0.5, -0.1)]))
    upright, _ = Rotation.align_vectors(fingers, _HAND_DIRECTION)
    spun = Rotation.from_rotvec(random.uniform(0, 2 * np.pi) * fingers)
    turned = (spun * upright).apply(vertices) * [side, 1, 1]
    if side < 0:
        faces = faces[:, [0, 2, 1]]
    azimuth = side * np.radians(random.uniform(8, 50))
    outward = np.array([np.sin(azimuth), 0, np.cos(azimuth)])
    tip = turned[(turned @ fingers) > np.quantile(turned @ fingers, 0.9)].mean(0)
    at = np.array([0, random.uniform(-0.07, -0.01), 0]) + outward * 0.3
    hull = hull_of(head)
    placed = turned - tip + at - (hull.height(at[None])[0] - 0.02) * outward
    placed = hull.lifted(placed, 0.003)
    hand = cloth_like("skin", placed, faces)
    hand.uv[:] = _SKIN_UV + 0.2 * (placed[:, :2] - placed[:, :2].mean(0)) / 0.1
    hand.label[:] = class_index("hand")
    wrist = placed[(placed @ fingers) < np.quantile(placed @ fingers, 0.04)].mean(0)
    down = unit(np.array([0.35 * side, -0.8, 0.3]) - fingers)
    sleeve = _tube("cloth", wrist - 0.02 * down, wrist + _ARM_M * down, _WRIST_M, _WRIST_M + 0.018)
    return joined(hand, sleeve)


def draw_microphone(random: np.random.Generator) -> HeadMesh:
    """Draw a microphone below the mouth, as part "frame"; it counts as held by a hand."""
    top = np.array([random.uniform(-0.04, 0.04), random.uniform(-0.11, -0.07), random.uniform(0.16, 0.19)])
    foot = top + unit(np.array([random.uniform(-0.5, 0.5), -1.0, random.uniform(0.1, 0.5)])) * 0.35
    angle = np.linspace(0.02, np.pi - 0.5, 12)[:, None]
    along = unit(foot - top)
    radius = random.uniform(0.019, 0.027)
    head_rings = _rings(top - along * np.cos(angle) * radius, along, np.sin(angle) * radius)
    stick = _tube("frame", top + 0.8 * radius * along, foot, 0.5 * radius, 0.45 * radius)
    whole = joined(ring_surface("frame", head_rings), stick)
    whole.label[:] = class_index("hand")
    return whole


def draw_earrings(lobes: list[np.ndarray], random: np.random.Generator) -> HeadMesh:
    """Draw a stud, a drop or a hoop at each lobe [3], as part "frame"; it counts as part of the ear."""
    kind = random.choice(["stud", "drop", "hoop"])
    size = random.uniform(0.0022, 0.004) if kind != "hoop" else random.uniform(0.007, 0.018)
    pieces = []
    for lobe in lobes:
        outward = np.array([np.sign(lobe[0]), 0.0, 0.4])
        at = lobe + 0.002 * unit(outward) + [0, 0.003, 0]
        if kind == "hoop":
            pieces.append(_hoop(at - [0, size, 0], size))
        else:
            low = at - [0, 0.0 if kind == "stud" else random.uniform(0.008, 0.018), 0]
            angle = np.linspace(0.02, np.pi - 0.02, 9)[:, None]
            up = np.array([0, 1.0, 0])
            pieces.append(
                ring_surface("frame", _rings(low + up * np.cos(angle) * size, -up, np.sin(angle) * size))
            )
    whole = joined(*pieces)
    whole.label[:] = class_index("ears")
    return whole


def _hoop(centre: np.ndarray, radius: float) -> HeadMesh:
    """A thin ring in the plane across the head."""
    turn = np.linspace(0, 2 * np.pi, 33)[:, None]
    away = np.concatenate([0 * turn, np.cos(turn), np.sin(turn)], 1)
    around = np.linspace(0, 2 * np.pi, 8, endpoint=False)
    rings = (
        centre
        + radius * away[:, None]
        + 0.0008
        * (np.cos(around)[None, :, None] * away[:, None] + np.sin(around)[None, :, None] * [1.0, 0, 0])
    )
    return ring_surface("frame", rings)


def _tube(part: str, start: np.ndarray, end: np.ndarray, wide_m: float, wider_m: float) -> HeadMesh:
    """An open tube between two points that widens."""
    share = np.linspace(0, 1, 24)[:, None]
    return ring_surface(
        part, _rings(start + share * (end - start), unit(end - start), wide_m + share * (wider_m - wide_m))
    )


def _rings(centres: np.ndarray, along: np.ndarray, radii: np.ndarray) -> np.ndarray:
    """Rings [R, N, 3] of radii [R, 1] about centres [R, 3], across a direction that leads down."""
    across = unit(np.cross(along, [0.0, 0, 1]))
    ahead = np.cross(across, along)
    turn = np.linspace(0, 2 * np.pi, _AROUND, endpoint=False)
    circle = np.cos(turn)[:, None] * ahead - np.sin(turn)[:, None] * across
    return centres[:, None] + radii[:, None] * circle
