"""The mesh of a synthetic head in named parts, and the arithmetic that the builders of the parts share."""

from dataclasses import dataclass, replace

import numpy as np
import torch

from facerf_cli.raster.texture import vertex_normals
from facerf_cli.synth.head.labels import part_class

PARTS = ("skin", "eye", "mouth", "teeth", "cloth", "hair", "frame", "hat")  # of HeadMesh.part, by index
CLOTH_M = 0.5  # size of the texture of cloth


@dataclass(frozen=True, eq=False)
class HeadMesh:
    """A head with its hair, clothes and glasses, in the head frame (`face.topology`), metres, float32.

    vertices, normals (unit) [V, 3]; triangles [F, 3] int64, counter-clockwise seen from outside, each within
    one part; part [V] uint8, an index into `PARTS`; uv [V, 2] in the texture of the part, row v = 0 at the
    top (skin: the face's UV map, continued beyond 0..1 over the rest of the head); tangents [V, 3] unit
    along a strand of hair, zero elsewhere; label [V] uint8, an index into `labels.CLASSES`.
    """

    vertices: np.ndarray
    normals: np.ndarray
    triangles: np.ndarray
    part: np.ndarray
    uv: np.ndarray
    tangents: np.ndarray
    label: np.ndarray


def joined(*meshes: HeadMesh) -> HeadMesh:
    """Concatenate several meshes into one."""
    offsets = np.cumsum([0, *(len(mesh.vertices) for mesh in meshes[:-1])])
    return HeadMesh(
        vertices=np.concatenate([mesh.vertices for mesh in meshes]),
        normals=np.concatenate([mesh.normals for mesh in meshes]),
        triangles=np.concatenate([m.triangles + offset for m, offset in zip(meshes, offsets, strict=True)]),
        part=np.concatenate([mesh.part for mesh in meshes]),
        uv=np.concatenate([mesh.uv for mesh in meshes]),
        tangents=np.concatenate([mesh.tangents for mesh in meshes]),
        label=np.concatenate([mesh.label for mesh in meshes]),
    )


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
    fields = ("vertices", "normals", "part", "uv", "tangents", "label")
    of_vertices = {name: getattr(mesh, name)[used] for name in fields}
    return replace(mesh, triangles=triangles.reshape(-1, 3), **of_vertices)


def ring_triangles(rings: int, segments: int) -> np.ndarray:
    """Triangles [F, 3] between closed rings of vertices.

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
    normals = vertex_normals(torch.from_numpy(vertices), torch.from_numpy(triangles)).numpy()
    uv = np.stack([0.5 + vertices[:, 0] / CLOTH_M, 0.5 - vertices[:, 1] / CLOTH_M], -1)
    return strandless(part, vertices, normals, triangles, uv)


def unit(vectors: np.ndarray) -> np.ndarray:
    """Vectors [..., 3] scaled to length 1; a zero vector stays zero."""
    return np.asarray(vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-12))


def smoothstep(value: np.ndarray, start: float = 0.0, end: float = 1.0) -> np.ndarray:
    """0 at and before `start`, 1 at and beyond `end`, a smooth cubic in between."""
    fraction = np.clip((value - start) / (end - start), 0, 1)
    return np.asarray(fraction * fraction * (3 - 2 * fraction))


def arc_lengths(points: np.ndarray) -> np.ndarray:
    """Arc length [N] from the first point to each point of a polyline [N, C]."""
    return np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=-1))])
