"""Meshes of heads and what is worn: parts and classes, subdivision, hulls, and packed MakeHuman meshes.

Loop's subdivision is a matrix from old to new vertices, which serves all shapes, colours and labels of a mesh
at once; trimesh's `subdivide_loop` gives the vertices of one shape.

A hull is measured from a capsule: above the middle of the skull along the ray from that middle, below it
along the horizontal from the vertical line through it. Crown, neck and shoulders thus all have one radius for
each azimuth and arc. Arc is 0 at the height of the middle, positive above, negative below.
"""

import math
from dataclasses import dataclass, replace
from functools import lru_cache
from importlib.resources import files

import numpy as np
import torch
from safetensors.numpy import load
from scipy.ndimage import distance_transform_edt, gaussian_filter, map_coordinates
from scipy.sparse import coo_matrix, csr_matrix

from facerf_cli.face.topology import BOTTOM_M, HALF_ANGLE_DEG, LANDMARK_UV, TOP_M, inside_mm
from facerf_cli.portrait.parse import class_index
from facerf_cli.raster.texture import vertex_normals
from facerf_cli.synth.random_fields import Random

# Parts of a mesh, in the order of their indices, and the class that all of a part has by default.
CLASS_OF_PART = {
    "skin": "skin",
    "eye": "eyes",
    "mouth": "mouth",
    "teeth": "mouth",
    "cloth": "garment",
    "hair": "hair",
    "frame": "glasses",
    "hat": "headwear",
}
PARTS = tuple(CLASS_OF_PART)
_OF_VERTICES = ("vertices", "normals", "part", "uv", "tangents", "label")  # fields of HeadMesh
CLOTH_M = 0.5  # size of the texture of cloth
# Lower edge of the face on the mean head: height in metres at an azimuth in degrees, the same on both sides.
# It follows the jaw to the lobe of the ear, then the nape below the hair.
_JAW_DEG = (0, 15, 27, 38, 50, 65, 80, 95, 110, 180)
_JAW_M = (-0.0755, -0.072, -0.064, -0.053, -0.046, -0.042, -0.041, -0.046, -0.05, -0.058)
_MARGIN_UV = 0.02  # around the landmarks, within which features of the face are looked for
_AZIMUTHS = 96
_ARC_M = 0.004  # height of a cell
HULL_RADIUS_M = 0.09  # arc per radian of elevation
_LOWEST_M = -0.36  # arc of the lowest row
_MIDDLE_M = 0.045  # height of the capsule's middle: the widest part of the skull, above the ears
_SLICE_M = (0.07, 0.09)  # front and back of the skull are measured between these heights
_STEP_M = 0.002  # for slopes of the field
_SMOOTH_CELLS = 0.8  # sigma of the Gaussian that smooths the field
MAKEHUMAN_LICENCE = "bodies and clothes: CC0 1.0 (MakeHuman)"
STEP_M = 2e-5  # unit of the stored coordinates
WHOLE = "whole "  # before the names of body and garments that reach to hips and hands
GARMENTS = (
    "tee",
    "loose tee",
    "v-neck",
    "round neck",
    "blouse",
    "sweater",
    "polo",
    "shirt",
    "jacket",
    "suit",
)
WHOLE_GARMENTS = tuple(name for name in GARMENTS if name != "v-neck")  # which ends at the waist


@dataclass(frozen=True, eq=False)
class HeadMesh:
    """Head with its hair, clothes and glasses, in the head frame (`face.topology`), metres, float32.

    vertices, normals (unit) [V, 3]; triangles [F, 3] int64, counter-clockwise seen from outside, each within
    one part; part [V] uint8, an index into `PARTS`; uv [V, 2] in the texture of the part, row v = 0 at the
    top (skin: the face's UV map, continued beyond 0..1 over the rest of the head); tangents [V, 3] unit
    along a strand of hair, zero elsewhere; label [V] uint8, an index into `portrait.parse.CLASSES`.
    """

    vertices: np.ndarray
    normals: np.ndarray
    triangles: np.ndarray
    part: np.ndarray
    uv: np.ndarray
    tangents: np.ndarray
    label: np.ndarray

    def is_part(self, *parts: str) -> np.ndarray:
        """[V] bool: vertices of some parts."""
        return np.isin(self.part, [PARTS.index(part) for part in parts])

    def faces_of(self, *parts: str) -> np.ndarray:
        """Return triangles [F, 3] of some parts."""
        return self.triangles[self.is_part(*parts)[self.triangles[:, 0]]]


def joined(*meshes: HeadMesh) -> HeadMesh:
    offsets = np.cumsum([0, *(len(mesh.vertices) for mesh in meshes[:-1])])
    triangles = [mesh.triangles + offset for mesh, offset in zip(meshes, offsets, strict=True)]
    of_vertices = {name: np.concatenate([getattr(mesh, name) for mesh in meshes]) for name in _OF_VERTICES}
    return HeadMesh(triangles=np.concatenate(triangles), **of_vertices)


def strandless(
    part: str, vertices: np.ndarray, normals: np.ndarray, triangles: np.ndarray, uv: np.ndarray
) -> HeadMesh:
    """Make a mesh of one part without tangents.

    Takes vertices and normals [N, 3] (normals of any length), triangles [F, 3], uv [N, 2].
    """
    normals = unit(normals)
    return HeadMesh(
        vertices=vertices.astype(np.float32),
        normals=normals.astype(np.float32),
        triangles=triangles.astype(np.int64),
        part=np.full(len(vertices), PARTS.index(part), np.uint8),
        uv=uv.astype(np.float32),
        tangents=np.zeros((len(vertices), 3), np.float32),
        label=np.full(len(vertices), part_class(part), np.uint8),
    )


def kept_triangles(mesh: HeadMesh, kept: np.ndarray) -> HeadMesh:
    """Select triangles [F] bool of a mesh, without the vertices that only others use."""
    used, triangles = np.unique(mesh.triangles[kept], return_inverse=True)
    of_vertices = {name: getattr(mesh, name)[used] for name in _OF_VERTICES}
    return replace(mesh, triangles=triangles.reshape(-1, 3), **of_vertices)


def ring_triangles(rings: int, segments: int) -> np.ndarray:
    """Return triangles [F, 3] between closed rings of vertices.

    They are counter-clockwise for a viewer who sees each ring counter-clockwise, and the next ring behind
    and around it.
    """
    ring, segment = np.meshgrid(np.arange(rings - 1), np.arange(segments), indexing="ij")
    a = ring * segments + segment
    b = ring * segments + (segment + 1) % segments
    c, d = a + segments, b + segments
    return np.stack([a, c, d, a, d, b], -1).reshape(-1, 3)


def capped(rings: int, segments: int) -> np.ndarray:
    """`ring_triangles` for a surface whose first and last ring are single points.

    Only one vertex of each of these two rings is used.
    """
    faces = ring_triangles(rings, segments)
    last = (rings - 1) * segments
    faces = np.where(faces < segments, 0, np.where(faces >= last, last, faces))
    a, b, c = faces.T
    return faces[(a != b) & (b != c) & (c != a)]


def ring_surface(part: str, rings: np.ndarray, closed: bool = True) -> HeadMesh:
    """Mesh rings [R, N, 3] that go down and, seen from outside, to the right; with a texture for cloth."""
    count, around = rings.shape[:2]
    ids = np.arange(count * around).reshape(count, around)
    if closed:
        ids = np.concatenate([ids, ids[:, :1]], 1)
    upper, lower = ids[:-1], ids[1:]
    quads = [(upper[:, :-1], lower[:, :-1], upper[:, 1:]), (upper[:, 1:], lower[:, :-1], lower[:, 1:])]
    return cloth_like(
        part, rings.reshape(-1, 3), np.concatenate([np.stack(q, -1).reshape(-1, 3) for q in quads])
    )


def cloth_like(part: str, vertices: np.ndarray, triangles: np.ndarray) -> HeadMesh:
    """Make a mesh of one part with smooth normals; its texture lies flat on it, seen from the front."""
    normals = smooth_normals(vertices, triangles)
    uv = np.stack([0.5 + vertices[:, 0] / CLOTH_M, 0.5 - vertices[:, 1] / CLOTH_M], -1)
    return strandless(part, vertices, normals, triangles, uv)


def smooth_normals(vertices: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """Unit normals [V, 3] of a mesh, area-weighted."""
    return vertex_normals(torch.from_numpy(vertices), torch.from_numpy(triangles)).numpy()


def doubled_areas(corners: np.ndarray) -> np.ndarray:
    """Twice the areas [F] of triangles with these corners [F, 3, 3]."""
    sides = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    return np.asarray(np.linalg.norm(np.cross(*sides), axis=-1))


def drawn_places(
    head: HeadMesh, triangles: np.ndarray, chance: np.ndarray, count: int, random: Random
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Draw places [N, 3] on triangles [F, 3] by chances [F]; return also normals [N, 3] and triangles [N]."""
    chosen = random.choice(len(triangles), count, p=chance / chance.sum())
    weights = random.dirichlet([1, 1, 1], count)[..., None]
    ids = triangles[chosen]
    normals = unit((head.normals[ids] * weights).sum(1))
    return (head.vertices[ids].astype(float) * weights).sum(1), normals, chosen


def unit(vectors: np.ndarray) -> np.ndarray:
    """Scale vectors [..., 3] to length 1; a zero vector stays zero."""
    return np.asarray(vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-12))


def smoothstep(value: np.ndarray, start: float = 0.0, end: float = 1.0) -> np.ndarray:
    """Return 0 at and before `start`, 1 at and beyond `end`, a smooth cubic in between."""
    fraction = np.clip((value - start) / (end - start), 0, 1)
    return np.asarray(fraction * fraction * (3 - 2 * fraction))


def arc_lengths(points: np.ndarray) -> np.ndarray:
    """Arc length [N] from the first point to each point of a polyline [N, C]."""
    return np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=-1))])


def part_class(part: str) -> int:
    """Return the class that all of a part has, unless its builder says otherwise."""
    return class_index(CLASS_OF_PART[part])


def skin_classes(uv: np.ndarray) -> np.ndarray:
    """Compute the classes [V] uint8 of skin, other than ears, at (u, v) [V, 2] of the continued UV map."""
    classes = np.full(len(uv), class_index("skin"), np.uint8)
    azimuth_deg, height_m = (uv[:, 0] - 0.5) * 2 * HALF_ANGLE_DEG, TOP_M - uv[:, 1] * (TOP_M - BOTTOM_M)
    classes[height_m < np.interp(np.abs(azimuth_deg), _JAW_DEG, _JAW_M)] = class_index("neck")
    low, high = LANDMARK_UV[17:].min(0) - _MARGIN_UV, LANDMARK_UV[17:].max(0) + _MARGIN_UV
    central = np.flatnonzero(((uv > low) & (uv < high)).all(-1))
    left = uv[central].copy()
    left[:, 0] = np.minimum(left[:, 0], 1 - left[:, 0])
    classes[central[inside_mm("brows", left) > 0]] = class_index("brows")
    classes[central[inside_mm("lips", uv[central]) > 0]] = class_index("lips")
    return classes


def loop_step(triangles: np.ndarray, count: int) -> tuple[csr_matrix, np.ndarray]:
    """Compute one step of Loop's subdivision for triangles [F, 3] of `count` vertices.

    Returns the matrix [count + E, count] from old to new vertices (the old ones first, then one per edge)
    and the new triangles [4 F, 3]. Vertices of no triangle stay; a border is smoothed as a separate curve.
    """
    sides = triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2)
    opposite = triangles[:, [2, 0, 1]].reshape(-1)
    edges, edge = np.unique(np.sort(sides, -1), axis=0, return_inverse=True)
    edge = edge.reshape(-1)
    inner = np.bincount(edge, minlength=len(edges)) == 2

    new = count + np.arange(len(edges))
    entries = [(new, edges[:, end], np.where(inner, 3 / 8, 1 / 2)) for end in (0, 1)]
    entries.append((new[edge[inner[edge]]], opposite[inner[edge]], np.array(1 / 8)))
    entries += _old_vertices(edges, inner, count)
    rows, columns, weights = zip(*entries, strict=True)
    weights = [np.broadcast_to(weight, row.shape) for row, weight in zip(rows, weights, strict=True)]
    step = coo_matrix(
        (np.concatenate(weights), (np.concatenate(rows), np.concatenate(columns))),
        shape=(count + len(edges), count),
    ).tocsr()

    ab, bc, ca = (count + edge.reshape(-1, 3)).T
    a, b, c = triangles.T
    divided = np.stack([a, ab, ca, ab, b, bc, ca, bc, c, ab, bc, ca], 1).reshape(-1, 3)
    return step, divided


def _old_vertices(
    edges: np.ndarray, inner: np.ndarray, count: int
) -> list[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Matrix entries (rows, columns, weights) of the old vertices; edges [E, 2], inner [E] bool."""
    border = np.zeros(count, bool)
    border[edges[~inner]] = True
    both = np.concatenate([edges, edges[:, ::-1]])
    both_inner = np.concatenate([inner, inner])
    valence = np.bincount(both[:, 0], minlength=count)
    share = np.zeros(count)  # weight of each neighbour of an old vertex inside the surface
    regular = valence > 0
    turn = 2 * math.pi / valence[regular]
    share[regular] = (5 / 8 - (3 / 8 + np.cos(turn) / 4) ** 2) / valence[regular]
    smooth = both[~border[both[:, 0]]]
    rim = both[~both_inner]
    rim_valence = np.bincount(rim[:, 0], minlength=count)
    every = np.arange(count)
    own = np.where(border, np.where(rim_valence == 2, 3 / 4, 1.0), 1 - valence * share)
    return [
        (smooth[:, 0], smooth[:, 1], share[smooth[:, 0]]),
        (rim[:, 0], rim[:, 1], np.where(rim_valence[rim[:, 0]] == 2, 1 / 8, 0.0)),
        (every, every, own),
    ]


@dataclass(frozen=True, eq=False)
class Hull:
    """Smooth closed surface around a head: its radius [rows, azimuths] in metres around `middle` [3]."""

    middle: np.ndarray
    radius: np.ndarray

    def height(self, points: np.ndarray) -> np.ndarray:
        """Return the distance [...] of points [..., 3] from the hull, along its ray; negative inside."""
        out, azimuth, arc = self._coordinates(points)
        column = azimuth / (2 * np.pi) * _AZIMUTHS
        row = np.clip((arc - _LOWEST_M) / _ARC_M, 0, len(self.radius) - 1)
        padded = np.concatenate([self.radius, self.radius[:, :1]], 1)
        return out - map_coordinates(padded, [row, column % _AZIMUTHS], order=1, mode="nearest")

    def rays(self, points: np.ndarray) -> np.ndarray:
        """Return the unit direction [..., 3] along which `height` measures points [..., 3]."""
        offset = points - self.middle
        offset = np.stack([offset[..., 0], np.maximum(offset[..., 1], 0), offset[..., 2]], -1)
        return unit(offset)

    def normals(self, points: np.ndarray) -> np.ndarray:
        """Unit normals [..., 3] of the level surfaces of height through points [..., 3]."""
        here = self.height(points)
        slope = np.stack([self.height(points + step) - here for step in np.eye(3) * _STEP_M], -1)
        return unit(slope)

    def lifted(self, points: np.ndarray, least: np.ndarray | float) -> np.ndarray:
        """Return points [..., 3] after those lower than `least` [...] are pushed out to that height."""
        short = np.maximum(least - self.height(points), 0)
        return points + short[..., None] * self.rays(points)

    def _coordinates(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Radius, azimuth in 0..2 pi and arc [...] of points [..., 3]."""
        x, y, z = np.moveaxis(points - self.middle, -1, 0)
        level = np.hypot(x, z)
        above = np.maximum(y, 0)
        arc = np.where(y > 0, HULL_RADIUS_M * np.arctan2(above, level), y)
        return np.hypot(level, above), np.arctan2(x, z) % (2 * np.pi), arc


def hull_of(head: HeadMesh) -> Hull:
    """Build the hull of a head's skin and clothes, if it wears any."""
    corners = head.vertices[head.faces_of("skin", "cloth")].astype(float)
    coarse = corners[np.linalg.norm(corners[:, 0] - corners[:, 1], axis=-1) > _ARC_M]
    sampled = [corners.mean(1), corners[:, 0], *(coarse[:, k] for k in (1, 2))]
    points = np.concatenate([*sampled, *((coarse[:, k] + coarse[:, k - 1]) / 2 for k in range(3))])
    hull = Hull(_middle(points), np.zeros((1, _AZIMUTHS)))
    out, azimuth, arc = hull._coordinates(points)
    rows = int((np.pi / 2 * HULL_RADIUS_M - _LOWEST_M) / _ARC_M) + 2
    row = np.clip(np.rint((arc - _LOWEST_M) / _ARC_M).astype(int), 0, rows - 1)
    column = np.rint(azimuth / (2 * np.pi) * _AZIMUTHS).astype(int) % _AZIMUTHS
    radius = np.zeros((rows, _AZIMUTHS))
    np.maximum.at(radius, (row, column), out)
    return Hull(hull.middle, gaussian_filter(_filled(radius), _SMOOTH_CELLS, mode=("nearest", "wrap")))


def _middle(points: np.ndarray) -> np.ndarray:
    """Return the capsule's middle [3], halfway between the forehead and the back of the skull."""
    belt = points[(points[:, 1] > _SLICE_M[0]) & (points[:, 1] < _SLICE_M[1])]
    return np.array([0, _MIDDLE_M, (belt[:, 2].min() + belt[:, 2].max()) / 2])


def _filled(radius: np.ndarray) -> np.ndarray:
    """Give cells that hold no point the radius of the nearest cell that does, also across the wrap-around."""
    third = radius.shape[1]
    tiled = np.tile(radius, (1, 3))
    nearest = distance_transform_edt(tiled == 0, return_distances=False, return_indices=True)
    return tiled[tuple(nearest)][:, third : 2 * third]


def packed_mesh(name: str) -> tuple[np.ndarray, np.ndarray]:
    """Read vertices [V, 3] (m, from the middle of the neck) and triangles [F, 3] of a packed shape."""
    tensors = _tensors()
    vertices = tensors[f"{name}.vertices"].astype(np.float64) * STEP_M
    return vertices, tensors[f"{name}.triangles"].astype(np.int64)


@lru_cache(maxsize=1)  # an asset of several MB
def _tensors() -> dict[str, np.ndarray]:
    return load(files("facerf_cli.assets").joinpath("makehuman.safetensors").read_bytes())
