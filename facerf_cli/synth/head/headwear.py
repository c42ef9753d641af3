"""Hats, caps, beanies and headscarves that fit a synthetic head.

Every piece encloses the skull at a distance off the hull of the bare head, down to an edge whose height
depends on the azimuth. Hair under it lies flat, and hair that would pierce it is left out.
"""

from dataclasses import dataclass, replace

import numpy as np

from facerf_cli.synth.head.hair_styles import HairStyle
from facerf_cli.synth.head.hull import RADIUS_M, Hull, hull_of
from facerf_cli.synth.head.makehuman import packed_mesh
from facerf_cli.synth.head.mesh import (
    HeadMesh,
    cloth_like,
    joined,
    kept_triangles,
    ring_surface,
    smoothstep,
    strandless,
)
from facerf_cli.synth.head.neckwear import draw_wraps
from facerf_cli.synth.head.subdivision import loop_step

HEADWEAR = ("fedora", "cap", "beanie", "headscarf")

_AROUND, _ROWS = 144, 40  # vertices around and rings of a shell
_HAIR_M = 0.004  # thickness of the hair below headwear
_FACE_DEG, _FACE_LOW_M = (
    56.0,
    -0.074,
)  # a headscarf leaves the face free, within this azimuth and above the chin


@dataclass(frozen=True, eq=False)
class Headwear:
    """A piece on a head: its mesh, and the shell that hair must not leave above the edge."""

    kind: str
    mesh: HeadMesh
    hull: Hull
    off_m: float  # from the hull to the shell
    edge_m: tuple[float, float, float]  # height of the edge at the front, the side and the back

    def flat(self, style: HairStyle) -> HairStyle:
        """The style as it lies under this piece."""
        comb = "whorl" if style.comb == "out" else style.comb
        thin = min(style.layer_mm, 1000 * _HAIR_M)
        return replace(
            style, layer_mm=thin, lift=min(style.lift, 0.2), comb=comb, stray=min(style.stray, 0.1)
        )

    def uncovered(self, hair: HeadMesh) -> HeadMesh:
        """The hair without triangles that would pierce the shell; under a headscarf none is left."""
        above = hair.vertices[:, 1] > _edge(self.edge_m, np.arctan2(hair.vertices[:, 0], hair.vertices[:, 2]))
        pierced = above & (self.hull.height(hair.vertices.astype(float)) > self.off_m - 0.0015)
        hidden = np.ones(len(pierced), bool) if self.kind == "headscarf" else pierced
        return kept_triangles(hair, ~hidden[hair.triangles].any(-1))


def draw_headwear(head: HeadMesh, chin_m: float, random: np.random.Generator) -> Headwear:
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
    """Points [..., 3] off the hull at azimuths and arcs above its middle (below it: heights)."""
    elevation = np.maximum(arc_m, 0) / RADIUS_M
    level = np.minimum(arc_m, 0)
    outward = np.stack(
        [np.cos(elevation) * np.sin(azimuth), np.sin(elevation), np.cos(elevation) * np.cos(azimuth)], -1
    )
    far = hull.middle + 0.5 * outward + level[..., None] * [0.0, 1.0, 0.0]
    return far - (hull.height(far) - off_m)[..., None] * outward


def _arc_of(hull: Hull, height_m: np.ndarray, azimuth: np.ndarray) -> np.ndarray:
    """The arcs [N] at which the hull has these heights [N] at azimuths [N]."""
    arcs = np.linspace(-0.1, 0.13, 47)
    heights = _on_hull(hull, azimuth[:, None], np.broadcast_to(arcs, (len(azimuth), 47)), np.zeros(47))[
        ..., 1
    ]
    return np.array([np.interp(h, row, arcs) for h, row in zip(height_m, heights, strict=True)])


def _shell(
    hull: Hull, edge_m: tuple[float, float, float], off_m: float, peak_m: float, ribbed: bool
) -> HeadMesh:
    """A cap over the skull from its edge to the crown, with a rolled band if it is knitted."""
    azimuth = np.linspace(0, 2 * np.pi, _AROUND, endpoint=False)
    low = _smooth_around(_arc_of(hull, _edge(edge_m, azimuth), azimuth))
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


def _smooth_around(values: np.ndarray) -> np.ndarray:
    """Values [N] around the head without steps."""
    kernel = np.hanning(15) / np.hanning(15).sum()
    return np.convolve(np.concatenate([values[-7:], values, values[:7]]), kernel, "valid")


def _visor(
    hull: Hull, edge_m: tuple[float, float, float], off_m: float, random: np.random.Generator
) -> HeadMesh:
    """The visor of a cap: a curved plate in front of the edge."""
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
    """MakeHuman's hat, stretched to the hull at its edge."""
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


def _headscarf(
    head: HeadMesh, hull: Hull, chin_m: float, off_m: float, random: np.random.Generator
) -> HeadMesh:
    """Cloth around skull, cheeks and neck that leaves the face free, wrapped below the chin."""
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
    wraps = draw_wraps(head, chin_m - 0.012, 2, random)
    return _as_hat(joined(*shells, wraps))


def _as_hat(mesh: HeadMesh) -> HeadMesh:
    """The same mesh as part "hat"."""
    like = strandless("hat", mesh.vertices, mesh.normals, mesh.triangles, mesh.uv)
    return replace(mesh, part=like.part, label=like.label)
