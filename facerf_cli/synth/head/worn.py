"""Headwear, neckwear and earrings, and a hand or a microphone held in front of the face.

Headwear encloses the skull at a distance off the hull of the bare head, down to an edge whose height depends
on the azimuth. Hair under it lies flat, and hair that would pierce it is left out.
"""

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from facerf_cli.portrait.parse import class_index
from facerf_cli.synth.head.hair_styles import HairStyle
from facerf_cli.synth.head.mesh import (
    HULL_RADIUS_M,
    HeadMesh,
    Hull,
    cloth_like,
    hull_of,
    joined,
    kept_triangles,
    loop_step,
    packed_mesh,
    ring_surface,
    smoothstep,
    strandless,
    unit,
)
from facerf_cli.synth.random_fields import Random

NECKWEAR = ("turtleneck", "scarf")

_NECK_AROUND = 144  # vertices around the neck
_NECK_ROWS = 26  # rings of a surface
_FLARE_M = 0.03  # below the chin the neck is at its narrowest
HEADWEAR = ("fedora", "cap", "beanie", "headscarf")
_AROUND, _ROWS = 144, 40  # vertices around and rings of a shell
_HAIR_M = 0.004  # thickness of the hair below headwear
_SMOOTHING = np.hanning(15)  # of a shell's edge
_FACE_DEG, _FACE_LOW_M = 56.0, -0.074  # a headscarf leaves the face free up to here, and above the chin
_TUBE_AROUND = 24  # vertices around arms, microphones and rings
_HAND_DIRECTION = unit(np.array([0.72, -0.66, 0.2]))  # of the packed hand's fingers
_WRIST_M = 0.035  # half width of the wrist
_ARM_M = 0.3  # length of the forearm
_SKIN_UV = (0.5, 1.2)  # a plain place of the skin's texture


def draw_neckwear(head: HeadMesh, chin_m: float, random: Random) -> HeadMesh:
    """Draw a turtleneck or a scarf for a bare head whose chin is at this height, as part "cloth"."""
    if random.choice(NECKWEAR) == "turtleneck":
        return _turtleneck(hull_of(head), chin_m, random)
    return draw_wraps(head, chin_m, int(random.integers(1, 3)), random)


def draw_wraps(head: HeadMesh, chin_m: float, count: int, random: Random) -> HeadMesh:
    """Draw turns of a scarf around the neck of a bare head, each below the one before."""
    hull = hull_of(head)
    return joined(*(_wrap(hull, chin_m, index, random) for index in range(count)))


def _turtleneck(hull: Hull, chin_m: float, random: Random) -> HeadMesh:
    """Build a band that stands around the neck and is folded over at its upper edge."""
    azimuth = np.linspace(0, 2 * np.pi, _NECK_AROUND, endpoint=False)
    slope = 0.012 * ((1 - np.cos(azimuth)) / 2) ** 0.8  # lower at the front than at the back
    top = chin_m - random.uniform(0.014, 0.028) + slope
    fold = random.uniform(0.055, 0.075)
    share = np.linspace(0, 1, _NECK_ROWS)[:, None]
    inner = share[:6] / share[5]
    level = np.concatenate([top - 0.03 + 0.03 * inner, top - fold * share[1:]])
    bulge = 0.0035 + 0.005 * np.sqrt(np.sin(np.pi * np.clip(share[1:], 0.02, 0.98)))
    off = np.concatenate([0.002 + 0 * inner, bulge])
    off = off + 0.0006 * np.sin(azimuth * 60) * (off > 0.003)  # ribs
    return _loft(hull, chin_m, azimuth, level, off)


def _wrap(hull: Hull, chin_m: float, index: int, random: Random) -> HeadMesh:
    """Build one turn of a scarf: a soft roll, hanging lower in front, with folds along it."""
    azimuth = np.linspace(0, 2 * np.pi, _NECK_AROUND, endpoint=False)
    around = np.linspace(0, 2 * np.pi, _NECK_ROWS)[:, None]
    high, deep = random.uniform(0.022, 0.032), random.uniform(0.022, 0.034)
    hang = random.uniform(0.01, 0.04) * ((1 + np.cos(azimuth)) / 2) ** 2
    roll = np.zeros((_NECK_ROWS, _NECK_AROUND))
    for _ in range(5):
        phase = random.integers(1, 5) * azimuth + random.integers(1, 6) * around + random.uniform(0, 6.3)
        roll += random.uniform(0.2, 0.6) * (1 - 2 * np.abs(np.sin(phase / 2)) ** 0.7)
    level = chin_m - 0.034 - 0.024 * index - hang + high * np.sin(around)
    off = 0.003 + deep * (1 - np.cos(around)) / 2 * (1 + 0.08 * roll)
    return _loft(hull, chin_m, azimuth, level, off)


def _loft(hull: Hull, chin_m: float, azimuth: np.ndarray, level: np.ndarray, off: np.ndarray) -> HeadMesh:
    """Mesh rings at heights [R, N] and distances [R, N] off the hull, at azimuths [N]."""
    level = np.broadcast_to(level, off.shape)
    outward = np.stack([np.sin(azimuth), 0 * azimuth, np.cos(azimuth)], -1)
    far = outward + np.array([0, 0, hull.middle[2]])
    far = np.stack([np.broadcast_to(far[:, 0], off.shape), level, np.broadcast_to(far[:, 2], off.shape)], -1)
    neck = np.maximum(level, chin_m - _FLARE_M)  # the shoulders begin below
    on_neck = np.stack([far[..., 0], neck, far[..., 2]], -1)
    rings = far - ((hull.height(on_neck) - off)[..., None]) * outward
    return ring_surface("cloth", rings if _faces_out(rings, outward) else rings[::-1])


def _faces_out(rings: np.ndarray, outward: np.ndarray) -> bool:
    """Test if rings [R, N, 3] go down on their outer side; outward [N, 3]: away from the neck."""
    reach = (rings * outward).sum(-1).mean(1)
    outer = int(reach.argmax())
    inner = rings[max(outer - 1, 0) : outer + 2, :, 1].mean(1)
    return bool(inner[0] > inner[-1])


@dataclass(frozen=True, eq=False)
class Headwear:
    """Piece on a head: its mesh, and the shell that hair must not leave above the edge."""

    kind: str
    mesh: HeadMesh
    hull: Hull
    off_m: float  # from the hull to the shell
    edge_m: tuple[float, float, float]  # height of the edge at the front, the side and the back

    def flat(self, style: HairStyle) -> HairStyle:
        comb = "whorl" if style.comb == "out" else style.comb
        thin = min(style.layer_mm, 1000 * _HAIR_M)
        return replace(
            style, layer_mm=thin, lift=min(style.lift, 0.2), comb=comb, stray=min(style.stray, 0.1)
        )

    def uncovered(self, hair: HeadMesh) -> HeadMesh:
        """Return the hair without triangles that would pierce the shell; under a headscarf none is left."""
        above = hair.vertices[:, 1] > _edge(self.edge_m, np.arctan2(hair.vertices[:, 0], hair.vertices[:, 2]))
        pierced = above & (self.hull.height(hair.vertices.astype(float)) > self.off_m - 0.0015)
        hidden = np.ones(len(pierced), bool) if self.kind == "headscarf" else pierced
        return kept_triangles(hair, ~hidden[hair.triangles].any(-1))


def draw_headwear(head: HeadMesh, chin_m: float, random: Random) -> Headwear:
    """Draw one piece for a bare head whose chin is at this height, as part "hat"."""
    hull, kind = hull_of(head), str(random.choice(HEADWEAR))
    off = _HAIR_M + random.uniform(0.003, 0.007)
    tilt = random.normal(0, 0.004)
    if kind == "fedora":
        edge = (0.092 + tilt, 0.075, 0.055 - tilt)
        return Headwear(kind, _fedora(hull, edge, off), hull, off, edge)
    if kind == "headscarf":
        edge = (0.086, -0.2, -0.2)
        return Headwear(kind, _headscarf(head, hull, chin_m, off, random), hull, off, edge)
    edge = (random.uniform(0.078, 0.098), 0.055 + tilt, random.uniform(0.0, 0.035))
    shell = _shell(hull, edge, off, random.uniform(0.0, 0.012), kind == "beanie")
    mesh = joined(shell, _visor(hull, edge, off, random)) if kind == "cap" else shell
    return Headwear(kind, mesh, hull, off, edge)


def _edge(edge_m: tuple[float, float, float], azimuth: np.ndarray) -> np.ndarray:
    """Height of the edge [...] at azimuths in radians."""
    return np.interp(np.abs(np.degrees((azimuth + np.pi) % (2 * np.pi) - np.pi)), (0, 90, 180), edge_m)


def _on_hull(hull: Hull, azimuth: np.ndarray, arc_m: np.ndarray, off_m: np.ndarray) -> np.ndarray:
    """Return points [..., 3] off the hull at azimuths and arcs above its middle (below it: heights)."""
    elevation = np.maximum(arc_m, 0) / HULL_RADIUS_M
    level = np.minimum(arc_m, 0)
    outward = np.stack(
        [np.cos(elevation) * np.sin(azimuth), np.sin(elevation), np.cos(elevation) * np.cos(azimuth)], -1
    )
    far = hull.middle + 0.5 * outward + level[..., None] * [0.0, 1.0, 0.0]
    return far - (hull.height(far) - off_m)[..., None] * outward


def _arc_of(hull: Hull, height_m: np.ndarray, azimuth: np.ndarray) -> np.ndarray:
    """Return the arcs [N] of the hull that have these heights [N] at azimuths [N]."""
    arcs = np.linspace(-0.1, 0.13, 47)
    heights = _on_hull(hull, azimuth[:, None], np.broadcast_to(arcs, (len(azimuth), 47)), np.zeros(47))[
        ..., 1
    ]
    return np.array([np.interp(h, row, arcs) for h, row in zip(height_m, heights, strict=True)])


def _shell(
    hull: Hull, edge_m: tuple[float, float, float], off_m: float, peak_m: float, ribbed: bool
) -> HeadMesh:
    """Build a cap over the skull from its edge to the crown, with a rolled band if it is knitted."""
    azimuth = np.linspace(0, 2 * np.pi, _AROUND, endpoint=False)
    low = _arc_of(hull, _edge(edge_m, azimuth), azimuth)
    low = np.convolve(np.concatenate([low[-7:], low, low[:7]]), _SMOOTHING / _SMOOTHING.sum(), "valid")
    share = np.linspace(0, 1, _ROWS)[:, None]
    arc = low + (0.141 - low) * share
    off = off_m + 0.002 + peak_m * smoothstep(share, 0.3, 1.0) * (1 + 0.4 * np.cos(azimuth))
    off = off + 0 * arc
    if ribbed:
        off = off + 0.005 * smoothstep(0.24 - share, 0, 0.04) * (1 + 0.15 * np.sin(72 * azimuth))
    inner = _on_hull(hull, azimuth, arc[:1] + 0.004, np.full((1, _AROUND), off_m - 0.002))
    rings = np.concatenate(
        [inner, _on_hull(hull, azimuth, arc[:1], off[:1] - 0.001), _on_hull(hull, azimuth, arc, off)]
    )
    return ring_surface("hat", rings[::-1])


def _visor(hull: Hull, edge_m: tuple[float, float, float], off_m: float, random: Random) -> HeadMesh:
    """Build the visor of a cap: a curved plate in front of the edge."""
    reach, drop = random.uniform(0.055, 0.075), random.uniform(0.008, 0.025)
    azimuth = np.linspace(-1.15, 1.15, 60)
    arc = _arc_of(hull, _edge(edge_m, azimuth), azimuth)
    base = _on_hull(hull, azimuth, arc + 0.004, np.full(60, off_m))
    side = azimuth / 1.15
    share = np.linspace(0, 1, 16)[:, None]
    ahead = reach * np.sqrt(np.maximum(1 - side**2, 0)) * share
    down = drop * (0.5 * share + 0.6 * side**2 * share) + 0.012 * share**2
    top = base + np.stack([0.25 * ahead * side, -down, ahead], -1)
    under = top - [0, 0.0025, 0]
    return ring_surface("hat", np.concatenate([top, under[::-1]]), closed=False)


def _fedora(hull: Hull, edge_m: tuple[float, float, float], off_m: float) -> HeadMesh:
    """Build MakeHuman's hat, stretched to the hull at its edge."""
    vertices, faces = packed_mesh("fedora")
    step, faces = loop_step(faces, len(vertices))
    vertices = step @ vertices
    crown = vertices[vertices[:, 1] > vertices[:, 1].min() + 0.03]
    centre, half = (crown.max(0) + crown.min(0)) / 2, (crown.max(0) - crown.min(0)) / 2
    azimuth = np.radians([0.0, 90.0, 180.0, 270.0])
    heights = np.array([edge_m[0], edge_m[1], edge_m[2], edge_m[1]])
    wanted = _on_hull(hull, azimuth, _arc_of(hull, heights, azimuth), np.full(4, off_m + 0.004))
    wide, deep = (wanted[1, 0] - wanted[3, 0]) / 2, (wanted[0, 2] - wanted[2, 2]) / 2
    middle = np.array([0, 0, (wanted[0, 2] + wanted[2, 2]) / 2])
    base = vertices[:, 1].min()
    placed = (vertices - [centre[0], base, centre[2]]) * [wide / half[0], 1.08, deep / half[2]] + middle
    slope = (edge_m[0] - edge_m[2]) / (2 * deep)
    placed[:, 1] += edge_m[1] - 0.004 + slope * (placed[:, 2] - middle[2])
    return cloth_like("hat", placed, faces)


def _headscarf(head: HeadMesh, hull: Hull, chin_m: float, off_m: float, random: Random) -> HeadMesh:
    """Build a cloth around skull, cheeks and neck that leaves the face free, wrapped below the chin."""
    azimuth = np.linspace(0, 2 * np.pi, _AROUND, endpoint=False)
    signed = (azimuth + np.pi) % (2 * np.pi) - np.pi
    open_rad = np.radians(_FACE_DEG)
    aside = np.clip(np.abs(signed) / open_rad, 0, 1)
    top = 0.088 - 0.05 * aside**2
    bottom = _FACE_LOW_M + 0.07 * aside**3
    share = np.linspace(0, 1, 3 * _ROWS)[:, None]
    crown = _arc_of(hull, top, azimuth)
    low = chin_m - 0.06 - hull.middle[1]
    faced = np.abs(signed) < open_rad
    upper = np.where(faced, crown, 0.0)
    arc_up = upper + (0.141 - upper) * share
    fold = 0.0015 * np.sin(9 * azimuth + 14 * share + random.uniform(0, 6.3))
    shells = [ring_surface("hat", _on_hull(hull, azimuth, arc_up, off_m + fold)[::-1])]
    under = np.where(faced, bottom - hull.middle[1], 0.0)
    arc_low = under + (low - under) * share
    shells.append(ring_surface("hat", _on_hull(hull, azimuth, arc_low, off_m + fold + 0.012 * share)))
    mesh = joined(*shells, draw_wraps(head, chin_m - 0.012, 2, random))
    like = strandless("hat", mesh.vertices, mesh.normals, mesh.triangles, mesh.uv)
    return replace(mesh, part=like.part, label=like.label)


def draw_hand(head: HeadMesh, random: Random) -> HeadMesh:
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


def draw_microphone(random: Random) -> HeadMesh:
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


def draw_earrings(lobes: list[np.ndarray], random: Random) -> HeadMesh:
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
    """Build a thin ring in the plane across the head."""
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
    """Build an open tube between two points that widens."""
    share = np.linspace(0, 1, 24)[:, None]
    return ring_surface(
        part, _rings(start + share * (end - start), unit(end - start), wide_m + share * (wider_m - wide_m))
    )


def _rings(centres: np.ndarray, along: np.ndarray, radii: np.ndarray) -> np.ndarray:
    """Return rings [R, N, 3] of radii [R, 1] about centres [R, 3], across a direction that leads down."""
    across = unit(np.cross(along, [0.0, 0, 1]))
    ahead = np.cross(across, along)
    turn = np.linspace(0, 2 * np.pi, _TUBE_AROUND, endpoint=False)
    circle = np.cos(turn)[:, None] * ahead - np.sin(turn)[:, None] * across
    return centres[:, None] + radii[:, None] * circle
